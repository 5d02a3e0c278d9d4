//! The configuration of the simulated pair.

use tandem_bridge::driver::Faults;
use tandem_core::ArmIndex;
use tandem_core::scene::Cuboid;
use tandem_kinematics::Joints;

/// Time from one exchange to the next, seconds: the arms take 100 commands per second.
pub const PERIOD_S: f64 = 0.01;
/// Physics steps in a period.
pub const N_SUBSTEPS: u32 = 4;

/// The properties of the simulated pair. The defaults approximate good hardware and differ from the training world on
/// purpose.
#[derive(Debug, Clone, PartialEq)]
pub struct SimulatedConfig {
    /// The seed of latencies and noise. The same seed and commands give the same bits.
    pub seed: u64,
    /// Smallest and largest number of periods until a command takes effect. Commands do not overtake each other.
    pub latency_periods: [u32; 2],
    /// Time constant with which a joint's speed follows its command, seconds.
    pub lag_s: f64,
    /// Largest acceleration of a joint by its motor, radians per second squared.
    pub motor_radps2: f64,
    /// Time in which a drive brakes a joint from its highest speed to rest, seconds.
    pub brake_s: f64,
    /// The opposing torque at which a joint stalls, newton metres, base to wrist. Kinova specifies peaks of 30.5 and
    /// 6.8 N m.
    pub stall_nm: [f64; 4],
    /// Whether the arms report their torques.
    pub reports_torques: bool,
    /// Standard deviation of reported angles, radians.
    pub angle_noise_rad: f64,
    /// Standard deviation of reported rates, radians per second.
    pub rate_noise_radps: f64,
    /// Standard deviation of reported torques, newton metres.
    pub torque_noise_nm: f64,
    /// Resolution of reported angles, radians.
    pub angle_step_rad: f64,
    /// The grippers.
    pub gripper: GripperConfig,
    /// The cameras that observe the objects.
    pub camera: CameraConfig,
    /// Coulomb friction coefficient between objects and table.
    pub table_friction: f32,
    /// The blocks on the table.
    pub blocks: Vec<Block>,
    /// The object that all arms share, if there is one. There are no blocks then.
    pub shared: Option<SharedObject>,
}

/// A gripper with two fingers that slide along y of the arm frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GripperConfig {
    /// Force with which each finger presses, newtons.
    pub grip_n: f32,
    /// Largest change of the opening, 1/s; 1 is from closed to open.
    pub opening_per_s: f32,
    /// Coulomb friction coefficient between the fingers' pads and objects.
    pub pad_friction: f32,
    /// Mass of a finger, kilograms.
    pub finger_kg: f32,
}

/// The cameras.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CameraConfig {
    /// Periods between two pictures.
    pub every_periods: u64,
    /// Periods from a picture until its objects are available.
    pub latency_periods: u64,
    /// Standard deviation of an observed position along each axis, metres.
    pub position_noise_m: f64,
    /// Standard deviation of an observed orientation about each axis, radians.
    pub orientation_noise_rad: f64,
}

/// A cube.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Block {
    /// Half the edge, metres.
    pub half_m: f32,
    /// Mass, kilograms, evenly spread.
    pub mass_kg: f32,
    /// The initial position: x and y in the world, metres.
    pub at_m: [f32; 2],
    /// The initial rotation about the vertical axis, radians.
    pub yaw_rad: f32,
}

/// A rigid body that all arms share. Points, boxes and poses are in the body's frame, metres.
#[derive(Debug, Clone, PartialEq)]
pub struct SharedObject {
    /// The boxes that collide.
    pub boxes: Vec<ObjectBox>,
    /// The boxes that scenes show: first the one of each arm, in arm order.
    pub shown: Vec<Cuboid>,
    /// For each arm, the point that it brings to its goal.
    pub points_m: Vec<[f32; 3]>,
    /// The initial position of the body's origin, world frame, metres.
    pub at_m: [f32; 3],
    /// The initial rotation about the vertical axis, radians.
    pub yaw_rad: f32,
}

/// A box of uniform density.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ObjectBox {
    /// The centre, in the body's frame, metres.
    pub centre_m: [f32; 3],
    /// Half the lengths of the edges, along the axes of the body, metres.
    pub half_m: [f32; 3],
    /// Mass, kilograms.
    pub mass_kg: f32,
}

impl SharedObject {
    /// Returns half the width on which the gripper of each arm closes: the width of the first shown box across the
    /// body's first axis, metres.
    #[must_use]
    pub fn grasped_half_m(&self) -> f32 {
        self.shown.first().map_or(0.0, |shown| shown.half_extents_m[1])
    }
}

impl Block {
    /// Returns a cube of 5.6 cm and 0.12 kg.
    #[must_use]
    pub fn small(at_m: [f32; 2]) -> Self {
        Self { half_m: 0.028, mass_kg: 0.12, at_m, yaw_rad: 0.0 }
    }

    /// Returns a cube of 9 cm and 0.25 kg.
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
            reports_torques: true,
            angle_noise_rad: 0.01_f64.to_radians(),
            rate_noise_radps: 0.1_f64.to_radians(),
            torque_noise_nm: 0.15,
            angle_step_rad: 0.01_f64.to_radians(),
            gripper: GripperConfig::default(),
            camera: CameraConfig::default(),
            table_friction: 0.5,
            blocks: Vec::new(),
            shared: None,
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
        Self {
            every_periods: 3,
            latency_periods: 5,
            position_noise_m: 0.001,
            orientation_noise_rad: 0.01,
        }
    }
}

/// An external disturbance of the arms, for tests of faults.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Disturbance {
    /// The joints that are blocked.
    pub blocked: Vec<(ArmIndex, usize)>,
    /// Errors that the servos add to commanded velocities, radians per second, arm by arm; empty for none. Braking
    /// drives do not drift.
    pub drift_radps: Vec<Joints>,
    /// External torques on the joints, newton metres, arm by arm; empty for none.
    pub torque_nm: Vec<Joints>,
    /// Faults that the arms report, arm by arm; empty for none. The drives of an arm with a drive fault or a pressed
    /// emergency stop brake.
    pub faults: Vec<Faults>,
}
