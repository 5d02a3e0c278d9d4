//! The hand of the training world, which the bridge simulates between the policy and the arms.

use glam::DVec3;
use tandem_sim::description::WorldDescription;

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
    /// The workspace of the end effector, own frame: low and high corner, metres.
    workspace_m: [DVec3; 2],
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
            opening_speed_mps: decimal(hand.opening_speed_mps),
        }
    }

    /// The duration of a control step, seconds.
    #[must_use]
    pub fn control_step_s(&self) -> f64 {
        self.control_step_s
    }

    /// Returns the position and velocity of the hand after a step with `action` (one arm's, in [−1, 1]) from `hand` with
    /// `velocity`; own frame, metres and metres per second.
    #[must_use]
    pub fn after(&self, hand: DVec3, velocity: DVec3, action: &[f32]) -> (DVec3, DVec3) {
        let [low, high] = self.workspace_m;
        let asked = DVec3::from_array([0, 1, 2].map(|axis| f64::from(action[axis])));
        let displacement = asked.clamp(DVec3::NEG_ONE, DVec3::ONE) * self.action_m;
        let target = (hand + displacement).clamp(low, high);
        let substep_s = self.control_step_s / f64::from(self.n_substeps);
        let most = DVec3::splat(self.acceleration_mps2 * substep_s);
        let (mut at, mut velocity) = (hand, velocity);
        for _ in 0..self.n_substeps {
            let desired = (target - at) * self.gain_per_s;
            let desired =
                self.max_speed_mps.map_or(desired, |speed| desired.clamp_length_max(speed));
            velocity += (desired - velocity).clamp(-most, most);
            at += velocity * substep_s;
        }
        (at.clamp(low, high), velocity)
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
            let (at, velocity) = hand.after(DVec3::ZERO, DVec3::ZERO, &ahead);
            assert!(at.x > 0.02 && at.x < farthest_m, "{task}: {at}");
            let (glided, _) = hand.after(at, velocity, &[0.0; 4]);
            assert!(glided.x > at.x, "{task}: {glided}");
            let low_z = hand.workspace_m[0].z;
            assert!((at.z - low_z).abs() < 1e-12, "{task}: the workspace's floor");
        }
        let slow = hand_of(Task::CarryBar);
        let (_, velocity) = slow.after(DVec3::Z, DVec3::ZERO, &[1.0, 1.0, -1.0, 0.0]);
        assert!(velocity.length() < 0.2 + 1e-9, "{velocity}");
        assert!((slow.opening_step_m() - 0.0625).abs() < 1e-12);
        assert!((hand_of(Task::PickAndPlace).opening_step_m() - 0.010).abs() < 1e-12);
    }
}
