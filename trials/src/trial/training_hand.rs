//! The hand of the training world, which the bridge simulates between the policy and the arms.

use glam::DVec3;
use tandem_sim::description::WorldDescription;
use tandem_sim::reach::Reach;

/// Distance that the hand keeps from the smallest radius that the arm reaches, metres: the bridge refuses motions that
/// bring an elbow within one degree of the end of its range.
const FOLDED_ROOM_M: f32 = 0.004;

/// The servo and the gripper of the training world's hand.
#[derive(Debug, Clone, PartialEq)]
pub struct TrainingHand {
    /// The duration of a control step, seconds.
    control_step_s: f64,
    /// The number of physics steps in a control step.
    n_substeps: u32,
    /// The gain from the distance to the target to the velocity, 1/s.
    gain_per_s: f64,
    /// The largest speed, metres per second, if it is limited.
    max_speed_mps: Option<f64>,
    /// The largest acceleration along an axis, metres per second squared.
    acceleration_mps2: f64,
    /// The displacement of an action of 1, metres.
    action_m: f64,
    /// The workspace of the end effector, arm frame: low and high corner, metres.
    workspace_m: [DVec3; 2],
    /// The part of the workspace that the arm reaches; all of it if there is none.
    reach: Option<&'static Reach>,
    /// The largest opening of each side of the gripper, metres.
    max_opening_m: f64,
    /// The speed of each side of the gripper at an action of 1, metres per second.
    opening_speed_mps: f64,
}

impl TrainingHand {
    /// Returns the hand of `world`.
    #[must_use]
    pub fn new(world: &WorldDescription) -> Self {
        let hand = &world.hand;
        let corner = |corner: [f32; 3]| DVec3::from_array(corner.map(decimal));
        Self {
            control_step_s: decimal(world.control_step_s),
            n_substeps: world.substeps,
            gain_per_s: decimal(hand.approach_gain_per_s),
            max_speed_mps: hand.max_speed_mps.map(decimal),
            acceleration_mps2: decimal(hand.palm_force_n) / decimal(hand.mass_kg),
            action_m: decimal(hand.action_m),
            workspace_m: [corner(hand.workspace_low_m), corner(hand.workspace_high_m)],
            reach: hand.reach,
            max_opening_m: decimal(hand.max_opening_m),
            opening_speed_mps: decimal(hand.opening_speed_mps),
        }
    }

    /// The duration of a control step, seconds.
    #[must_use]
    pub fn control_step_s(&self) -> f64 {
        self.control_step_s
    }

    /// Returns the position and velocity of the hand after a step with `action` (one arm's, shape `[action_per_arm]`,
    /// in [−1, 1]) from `hand` with `velocity`; arm frame, metres and metres per second.
    ///
    /// # Panics
    /// Panics if the action has fewer than three numbers.
    #[must_use]
    pub fn after(&self, hand: DVec3, velocity: DVec3, action: &[f32]) -> (DVec3, DVec3) {
        let asked = DVec3::from_array([0, 1, 2].map(|axis| f64::from(action[axis])));
        let displacement = asked.clamp(DVec3::NEG_ONE, DVec3::ONE) * self.action_m;
        let target = self.reachable(hand + displacement);
        let substep_s = self.control_step_s / f64::from(self.n_substeps);
        let most = DVec3::splat(self.acceleration_mps2 * substep_s);
        let (mut position, mut velocity) = (hand, velocity);
        for _ in 0..self.n_substeps {
            let desired = (target - position) * self.gain_per_s;
            let desired =
                self.max_speed_mps.map_or(desired, |speed| desired.clamp_length_max(speed));
            velocity += (desired - velocity).clamp(-most, most);
            position += velocity * substep_s;
        }
        (self.reachable(position), velocity)
    }

    /// Returns the nearest position to `position` that the hand may have; arm frame, metres.
    #[must_use]
    pub fn reachable(&self, position: DVec3) -> DVec3 {
        let [low, high] = self.workspace_m;
        let position = position.clamp(low, high);
        self.reach.map_or(position, |reach| {
            let reached = reach.clamp(position.as_vec3());
            let [nearest_m, _] = reach.radii_m(reached.z);
            let radius_m = reach.radius_m(reached.to_array());
            let missing_m = (nearest_m + FOLDED_ROOM_M - radius_m).max(0.0);
            let outward = (reached - reach.axis(reached.z)) / radius_m;
            (reached + outward * missing_m).as_dvec3()
        })
    }

    /// Returns the velocity at the end of a step per displacement in it, in metres per step and metre, for a body that
    /// approaches its target as the hand does: exponentially.
    #[must_use]
    pub fn end_velocity_share(&self) -> f64 {
        let exponent = self.gain_per_s * self.control_step_s;
        exponent / (libm::exp(exponent) - 1.0)
    }

    /// The smallest height of the end effector above the table, metres.
    #[must_use]
    pub fn lowest_m(&self) -> f64 {
        self.workspace_m[0].z
    }

    /// The largest opening of each side of the gripper, metres.
    #[must_use]
    pub fn max_opening_m(&self) -> f64 {
        self.max_opening_m
    }

    /// Returns the change of the gripper's opening in a step with an action of 1, metres on each side.
    #[must_use]
    pub fn opening_step_m(&self) -> f64 {
        self.opening_speed_mps * self.control_step_s
    }
}

/// Returns the decimal number of at most six places that a constant in single precision stands for.
fn decimal(number: f32) -> f64 {
    (f64::from(number) * 1e6).round() / 1e6
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DVec2, Vec3Swizzles as _};
    use tandem_core::{Layout, Task};
    use tandem_sim::{Env, WorldConfig};

    fn hand_of(task: Task) -> TrainingHand {
        let env = Env::new(Layout::new(task, 2), &WorldConfig::default()).unwrap();
        TrainingHand::new(&env.description())
    }

    #[test]
    fn a_hand_glides_and_keeps_the_speed_limit_of_its_world() {
        let ahead = [1.0, 0.0, 0.0, 0.0];
        for (task, farthest_m) in [(Task::PickAndPlace, 0.05), (Task::CarryBar, 0.05)] {
            let hand = hand_of(task);
            let (position, velocity) = hand.after(DVec3::ZERO, DVec3::ZERO, &ahead);
            assert!(position.x > 0.02 && position.x < farthest_m, "{task}: {position}");
            let (glided, _) = hand.after(position, velocity, &[0.0; 4]);
            assert!(glided.x > position.x, "{task}: {glided}");
            let low_z = hand.workspace_m[0].z;
            assert!((position.z - low_z).abs() < 1e-12, "{task}: the workspace's floor");
        }
        let shared = hand_of(Task::SharedPush);
        let (far, _) = shared.after(DVec3::new(0.2, 0.15, 0.3), DVec3::ZERO, &ahead);
        assert!((far.xy() + DVec2::X * 0.22).length() < 0.376, "{far}: out of the arm's reach");
        let folded = shared.reachable(DVec3::new(-0.2, 0.0, 0.25)).xy() + DVec2::X * 0.22;
        assert!((folded.length() - 0.186).abs() < 1e-6, "{folded}: the elbow is folded");
        let slow = hand_of(Task::CarryBar);
        let (_, velocity) = slow.after(DVec3::Z, DVec3::ZERO, &[1.0, 1.0, -1.0, 0.0]);
        assert!(velocity.length() < 0.2 + 1e-9, "{velocity}");
        assert!((slow.opening_step_m() - 0.0625).abs() < 1e-12);
        assert!((hand_of(Task::PickAndPlace).opening_step_m() - 0.010).abs() < 1e-12);
    }
}
