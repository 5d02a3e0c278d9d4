//! Everything that can be set about the simulated pair.

use tandem_core::ArmIndex;
use tandem_kinematics::Joints;

/// Time from one exchange to the next, seconds: the arms want 100 commands a second.
pub const PERIOD_S: f64 = 0.01;
/// Physics steps in a period.
pub const N_SUBSTEPS: u32 = 4;

/// What the simulated pair is like. The defaults are a guess at good hardware, on purpose not the training world.
#[derive(Debug, Clone, PartialEq)]
pub struct SimulatedConfig {
    /// Decides latencies and noise; the same seed and commands give the same bits.
    pub seed: u64,
    /// Least and most periods from a command's arrival until it takes effect. Commands do not overtake each other.
    pub latency_periods: [u32; 2],
    /// Time constant with which a joint's speed follows its command, seconds.
    pub lag_s: f64,
    /// Largest acceleration that the motors give a joint, radians per second squared.
    pub motor_radps2: f64,
    /// Time in which a drive brakes a joint from its largest speed to rest, seconds.
    pub brake_s: f64,
    /// A joint stalls when more than this acts against it, newton metres, base to wrist. Kinova gives the actuators
    /// a peak of 30.5 and 6.8 N m.
    pub stall_nm: [f64; 4],
    /// Whether the arms tell their torques.
    pub tells_torques: bool,
    /// Standard deviations of what the joints report: angles (radians), their rates (radians per second), torques (newton metres).
    pub angle_noise_rad: f64,
    /// See `angle_noise_rad`.
    pub rate_noise_radps: f64,
    /// See `angle_noise_rad`.
    pub torque_noise_nm: f64,
    /// Angles are reported in whole steps of this size, radians.
    pub angle_step_rad: f64,
    /// The grippers.
    pub gripper: GripperConfig,
    /// The cameras that see the objects.
    pub camera: CameraConfig,
    /// Friction between objects and table; between the two the smaller one would hold as well.
    pub table_friction: f32,
    /// What lies on the table.
    pub blocks: Vec<Block>,
}

/// A gripper with two fingers that slide along y of the arm's own frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GripperConfig {
    /// Force with which each finger presses, newtons.
    pub grip_n: f32,
    /// Change of the opening at most, 1/s; 1 is from shut to open.
    pub opening_per_s: f32,
    /// Friction between the fingers' pads and objects.
    pub pad_friction: f32,
    /// Mass of a finger, kilograms.
    pub finger_kg: f32,
}

/// How objects are seen.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CameraConfig {
    /// Periods from picture to picture.
    pub every_periods: u64,
    /// Periods from a picture until its objects are known.
    pub latency_periods: u64,
    /// Standard deviation of a seen place along each axis, metres.
    pub place_noise_m: f64,
    /// Standard deviation of a seen turn about each axis, radians.
    pub turn_noise_rad: f64,
}

/// A cube.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Block {
    /// Half an edge, metres.
    pub half_m: f32,
    /// Mass, kilograms, evenly spread.
    pub mass_kg: f32,
    /// Where it lies at the start: x and y in the world, metres.
    pub at_m: [f32; 2],
    /// How it is turned about the upright axis, radians.
    pub yaw_rad: f32,
}

impl Block {
    /// The cube of 5.6 cm and 0.12 kg.
    #[must_use]
    pub fn small(at_m: [f32; 2]) -> Self {
        Self { half_m: 0.028, mass_kg: 0.12, at_m, yaw_rad: 0.0 }
    }

    /// The cube of 9 cm and 0.25 kg.
    #[must_use]
    pub fn large(at_m: [f32; 2]) -> Self {
        Self { half_m: 0.045, mass_kg: 0.25, at_m, yaw_rad: 0.0 }
    }
}

impl Default for SimulatedConfig {
    fn default() -> Self {
        Self {
            seed: 0,
            latency_periods: [1, 2],
            lag_s: 0.010,
            motor_radps2: 30.0,
            brake_s: 0.040,
            stall_nm: [30.5, 30.5, 30.5, 6.8],
            tells_torques: true,
            angle_noise_rad: 0.01_f64.to_radians(),
            rate_noise_radps: 0.1_f64.to_radians(),
            torque_noise_nm: 0.15,
            angle_step_rad: 0.01_f64.to_radians(),
            gripper: GripperConfig::default(),
            camera: CameraConfig::default(),
            table_friction: 0.5,
            blocks: Vec::new(),
        }
    }
}

impl Default for GripperConfig {
    fn default() -> Self {
        Self { grip_n: 12.0, opening_per_s: 1.0, pad_friction: 0.8, finger_kg: 0.06 }
    }
}

impl Default for CameraConfig {
    fn default() -> Self {
        Self { every_periods: 3, latency_periods: 5, place_noise_m: 0.001, turn_noise_rad: 0.01 }
    }
}

/// What can be done to the arms from outside, for rehearsals of what goes wrong.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Disturbance {
    /// A joint that does not turn.
    pub blocked: Option<(ArmIndex, usize)>,
    /// What the servos add to every commanded velocity, radians per second, arm by arm; empty for nothing. Braking
    /// drives do not drift.
    pub drift_radps: Vec<Joints>,
    /// Torques of somebody who leans on the arms, newton metres, arm by arm; empty for none.
    pub torque_nm: Vec<Joints>,
}
