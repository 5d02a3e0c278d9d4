//! The posture of the shared world's arms: Kinova's Mico with four joints, in closed form.
//!
//! Upper arm and forearm lie in the vertical plane through the base's axis and the end effector, with the elbow up. The
//! hand continues the forearm, so the position of the end effector determines how far it tilts. The last joint rotates
//! the fingers about the hand's axis until they close as nearly along y as the tilt permits. Lengths and radii are those
//! of [`MICO_4`]; the 7 mm between the base's axis and the plane are left out, so that postures have mirror images.

use rapier3d::glamx::DVec3;
use rapier3d::math::{Matrix, Rotation, Vector};
use serde::Serialize;
use tandem_core::World;
use tandem_kinematics::{MICO_4, PADS_AHEAD_M};

/// Sine of the elbow's bend below which the arm counts as stretched. Positions within reach bend it by 20 degrees and
/// more.
const MIN_SIN_BEND: f32 = 0.2;

/// The lengths of an arm and the place of its shoulder.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Mico {
    /// Arm frame, metres.
    shoulder: Vector,
    upper_arm_m: f32,
    /// From the elbow to the last joint, metres.
    forearm_m: f32,
    /// From the elbow to the end effector, metres.
    reach_m: f32,
}

/// An arm at a position of its end effector; arm frame, metres.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Posture {
    mico: Mico,
    /// Unit vector from the base's axis to the end effector, horizontal.
    ahead: Vector,
    /// Distance of the end effector from the base's axis, metres.
    radius_m: f32,
    /// Sine and cosine of the angle of the upper arm from the vertical.
    upper: [f32; 2],
    /// Sine and cosine of the angle of forearm and hand from the vertical; −1 is the cosine of a hand that points down.
    fore: [f32; 2],
}

/// The joints of an arm and their Jacobians with respect to the position of the end effector; arm frame, metres.
pub(crate) struct JointPoints {
    pub(crate) shoulder: Vector,
    pub(crate) elbow: (Vector, Matrix),
    pub(crate) wrist: (Vector, Matrix),
}

/// The lengths of a Mico, whose upper arm and forearm lie in the vertical plane through the base's axis and the end
/// effector, with the elbow up. The hand continues the forearm, and its fingers close as nearly along y of the arm's
/// frame as its tilt permits.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct MicoKinematics {
    /// Position of the shoulder, arm frame, metres.
    pub shoulder_in_arm_m: [f32; 3],
    /// Length of the upper arm, metres.
    pub upper_arm_m: f32,
    /// From the elbow to the last joint, metres.
    pub forearm_m: f32,
    /// From the elbow to the end effector, metres.
    pub elbow_to_end_effector_m: f32,
    /// Sine of the elbow's bend below which the arm counts as stretched.
    pub min_sin_bend: f32,
}

impl Mico {
    /// Returns the arm whose base is placed as in the shared world's work cell.
    pub(crate) fn in_shared_world() -> Self {
        let lengths = MICO_4.plane_lengths_m();
        let [height_m, upper_arm_m, forearm_m, hand_m] = [
            lengths.shoulder_height_m,
            lengths.upper_arm_m,
            lengths.forearm_m,
            lengths.hand_m + PADS_AHEAD_M,
        ]
        .map(single);
        Self {
            shoulder: Vector::new(-World::Shared.mico_base_distance_m(), 0.0, height_m),
            upper_arm_m,
            forearm_m,
            reach_m: forearm_m + hand_m,
        }
    }

    /// Returns the lengths as data.
    pub(crate) fn describe(&self) -> MicoKinematics {
        MicoKinematics {
            shoulder_in_arm_m: self.shoulder.to_array(),
            upper_arm_m: self.upper_arm_m,
            forearm_m: self.forearm_m,
            elbow_to_end_effector_m: self.reach_m,
            min_sin_bend: MIN_SIN_BEND,
        }
    }

    /// Returns the posture with the end effector at `end_effector`, arm frame, metres. Beyond its reach the arm is
    /// nearly stretched towards it.
    pub(crate) fn posture(&self, end_effector: Vector) -> Posture {
        let offset = end_effector - self.shoulder;
        let radius_m = hypotenuse(offset.x, offset.y).max(1e-3);
        let ahead = Vector::new(offset.x / radius_m, offset.y / radius_m, 0.0);
        let distance_m = hypotenuse(radius_m, offset.z);
        let (upper_m, fore_m) = (self.upper_arm_m, self.reach_m);
        let squares = upper_m * upper_m + fore_m * fore_m;
        let most = (1.0 - MIN_SIN_BEND * MIN_SIN_BEND).sqrt();
        let cos_bend =
            ((distance_m * distance_m - squares) / (2.0 * upper_m * fore_m)).clamp(-most, most);
        let sin_bend = (1.0 - cos_bend * cos_bend).sqrt();
        // The target as seen from the shoulder, and from the upper arm's line.
        let target = [radius_m / distance_m, offset.z / distance_m];
        let beyond = [fore_m * sin_bend, upper_m + fore_m * cos_bend];
        let length_m = hypotenuse(beyond[0], beyond[1]);
        let upper = difference(target, beyond.map(|part| part / length_m));
        Posture { mico: *self, ahead, radius_m, upper, fore: sum(upper, [sin_bend, cos_bend]) }
    }
}

impl Posture {
    /// Returns the orientation of the hand in the arm's frame. Its fingers close along y and it points along −z.
    pub(crate) fn orientation(&self) -> Rotation {
        let up = -self.along(self.fore);
        let closing = (Vector::Y - up * up.y).normalize();
        Rotation::from_mat3(&Matrix::from_cols(closing.cross(up), closing, up))
    }

    /// Returns the angular velocity of the hand while the end effector moves with `velocity`; arm frame, radians and
    /// metres per second.
    pub(crate) fn angular_velocity(&self, velocity: Vector) -> Vector {
        let [_, fore_rates] = self.angle_rates();
        let aside = self.aside();
        let fore_radps = fore_rates[0] * velocity.dot(self.ahead) + fore_rates[1] * velocity.z;
        let azimuth_radps = velocity.dot(aside) / self.radius_m;
        let up = -self.along(self.fore);
        let up_rate = self.across(self.fore) * -fore_radps - aside * (self.fore[0] * azimuth_radps);
        // The fingers stay as near to y as they can.
        let closing = (Vector::Y - up * up.y).normalize();
        let spin_radps = up.y * up_rate.dot(closing.cross(up)) / (1.0 - up.y * up.y).sqrt();
        up.cross(up_rate) + up * spin_radps
    }

    /// Returns the joints of the arm and how they follow the end effector.
    pub(crate) fn joints(&self) -> JointPoints {
        let Mico { shoulder, upper_arm_m, forearm_m, .. } = self.mico;
        let elbow = self.along(self.upper) * upper_arm_m;
        let wrist = elbow + self.along(self.fore) * forearm_m;
        let aside = self.aside();
        let [upper_rates, fore_rates] = self.angle_rates();
        let jacobian = |point: Vector, forearm_m: f32| {
            let column = |rate: usize| {
                self.across(self.upper) * (upper_arm_m * upper_rates[rate])
                    + self.across(self.fore) * (forearm_m * fore_rates[rate])
            };
            let turn = aside * (point.dot(self.ahead) / self.radius_m);
            let (ahead, up) = (column(0), column(1));
            let along =
                |axis: Vector| ahead * self.ahead.dot(axis) + up * axis.z + turn * aside.dot(axis);
            Matrix::from_cols(along(Vector::X), along(Vector::Y), along(Vector::Z))
        };
        JointPoints {
            shoulder,
            elbow: (shoulder + elbow, jacobian(elbow, 0.0)),
            wrist: (shoulder + wrist, jacobian(wrist, forearm_m)),
        }
    }

    /// Returns the rates of the angles of upper arm and forearm per displacement of the end effector ahead and up,
    /// radians per metre.
    fn angle_rates(&self) -> [[f32; 2]; 2] {
        let [sin_bend, _] = difference(self.fore, self.upper);
        let upper_rates = self.fore.map(|part| part / (self.mico.upper_arm_m * sin_bend));
        let fore_rates = self.upper.map(|part| -part / (self.mico.reach_m * sin_bend));
        [upper_rates, fore_rates]
    }

    /// Returns the horizontal unit vector across the plane of the arm.
    fn aside(&self) -> Vector {
        Vector::new(-self.ahead.y, self.ahead.x, 0.0)
    }

    /// Returns the derivative of [`along`](Self::along) with respect to the angle.
    fn across(&self, [sin, cos]: [f32; 2]) -> Vector {
        self.ahead * cos - Vector::Z * sin
    }

    /// Returns the unit vector in the plane of the arm at an angle from the vertical, given by sine and cosine.
    fn along(&self, [sin, cos]: [f32; 2]) -> Vector {
        self.ahead * sin + Vector::Z * cos
    }
}

/// Returns sine and cosine of the sum of two angles.
fn sum([sin, cos]: [f32; 2], [sin_other, cos_other]: [f32; 2]) -> [f32; 2] {
    [sin * cos_other + cos * sin_other, cos * cos_other - sin * sin_other]
}

/// Returns sine and cosine of the difference of two angles.
fn difference(angle: [f32; 2], [sin, cos]: [f32; 2]) -> [f32; 2] {
    sum(angle, [-sin, cos])
}

/// Converts to the single precision of the simulation.
pub(crate) fn single(value: f64) -> f32 {
    DVec3::splat(value).as_vec3().x
}

/// Returns the length of a vector from its square, which has the same bits on every platform.
pub(crate) fn hypotenuse(x: f32, y: f32) -> f32 {
    (x * x + y * y).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use tandem_core::rng::uniform;
    use tandem_core::{Stream, episode_rng};

    use crate::parameters::WorldParameters;

    /// Draws positions of the end effector within reach.
    fn positions() -> Vec<Vector> {
        let parameters = WorldParameters::of(World::Shared);
        let (low, high) = (parameters.workspace_low, parameters.workspace_high);
        let mut rng = episode_rng(5, 0, Stream::Reset);
        let mut draw = || {
            let at = |axis: usize| (low[axis], high[axis]);
            Vector::from_array([0, 1, 2].map(|axis| {
                let (low, high) = at(axis);
                uniform(&mut rng, low, high)
            }))
        };
        (0..2000).map(|_| draw()).filter(|at| parameters.contains(*at)).collect()
    }

    #[test]
    fn links_keep_their_lengths_and_the_hand_continues_the_forearm() {
        let mico = Mico::in_shared_world();
        for at in positions() {
            let posture = mico.posture(at);
            let joints = posture.joints();
            let (elbow, wrist) = (joints.elbow.0, joints.wrist.0);
            assert!(((elbow - joints.shoulder).length() - mico.upper_arm_m).abs() < 1e-5);
            assert!(((at - elbow).length() - mico.reach_m).abs() < 1e-5, "{at}");
            assert!((wrist - elbow).cross(at - elbow).length() < 1e-5);
            let pointing = posture.orientation() * Vector::NEG_Z;
            assert!((pointing - (at - elbow).normalize()).length() < 1e-4);
            assert!(elbow.z > 0.2, "the elbow is up: {elbow}");
            let tilt_rad = (-pointing.z).acos();
            assert!(tilt_rad < 46.0_f32.to_radians(), "{at}: {} degrees", tilt_rad.to_degrees());
        }
    }

    #[test]
    fn joints_move_with_the_end_effector_as_their_jacobians_predict() {
        let mico = Mico::in_shared_world();
        let offset = Vector::new(0.001, -0.0007, 0.0009);
        for at in positions() {
            let (before, after) = (mico.posture(at).joints(), mico.posture(at + offset).joints());
            for (before, after) in [(before.elbow, after.elbow), (before.wrist, after.wrist)] {
                let error = after.0 - before.0 - before.1 * offset;
                assert!(error.length() < 5e-5, "{at}: {error}");
            }
        }
    }

    #[test]
    fn the_angular_velocity_is_the_rate_of_the_orientation() {
        let mico = Mico::in_shared_world();
        let velocity = Vector::new(0.11, -0.12, 0.09);
        for at in positions() {
            let turn = |time_s: f32| mico.posture(at + velocity * time_s).orientation();
            let change = turn(0.005) * turn(-0.005).inverse();
            let measured = Vector::new(change.x, change.y, change.z) * (change.w.signum() * 200.0);
            let error = measured - mico.posture(at).angular_velocity(velocity);
            assert!(error.length() < 2e-3, "{at}: {error}");
        }
    }

    #[test]
    fn postures_have_mirror_images() {
        let mico = Mico::in_shared_world();
        let mirror = |point: Vector| Vector::new(point.x, -point.y, point.z);
        for at in positions() {
            let (posture, other) = (mico.posture(at), mico.posture(mirror(at)));
            let axis = Vector::new(0.3, 0.5, 0.8);
            let reflected = mirror(posture.orientation() * mirror(axis));
            assert!((other.orientation() * axis - reflected).length() < 1e-5);
        }
    }
}
