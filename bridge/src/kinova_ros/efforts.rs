//! Torques that have changed, from efforts that include the arm's own weight. Pure.

use tandem_kinematics::Joints;

use crate::kinova_ros::protocol::ArmMessage;

/// The moving mean of an arm's efforts.
///
/// The weight that a joint carries changes slowly with the arm's posture, and a collision changes its effort at once.
#[derive(Debug, Clone, Default)]
pub(crate) struct MeanEfforts {
    /// The time stamp of the last state, seconds, and the mean, newton metres.
    newest: Option<(f64, Joints)>,
}

impl MeanEfforts {
    /// Replaces the torques of `state` by their difference from the mean, whose time constant is `mean_s`. The first
    /// state, and one that comes long after the previous one, set the mean.
    pub(crate) fn subtract(&mut self, mean_s: f64, state: &mut ArmMessage) {
        let Some(efforts) = state.reading.torques_nm else { return };
        let (before_s, before) = self.newest.unwrap_or((f64::NEG_INFINITY, efforts));
        let kept = (-(state.stamp_s - before_s).max(0.0) / mean_s).exp();
        let mean = Joints::from_fn(efforts.len(), |joint| {
            efforts[joint] + kept * (before[joint] - efforts[joint])
        });
        self.newest = Some((state.stamp_s, mean));
        let change = |joint: usize| efforts[joint] - mean[joint];
        state.reading.torques_nm = Some(Joints::from_fn(efforts.len(), change));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::driver::{ArmReading, Faults};

    /// Torques for efforts of joint 2 (newton metres) every 0.1 s.
    fn torques(efforts_nm: impl Fn(f64) -> f64) -> Vec<f64> {
        let mut mean = MeanEfforts::default();
        let joints = |effort_nm| Joints::new(&[0.0, effort_nm, 0.0, 0.0]);
        let torque = |n: u32| {
            let stamp_s = 0.1 * f64::from(n);
            let reading = ArmReading {
                angles: joints(0.0),
                velocities: joints(0.0),
                torques_nm: Some(joints(efforts_nm(stamp_s))),
                opening: 1.0,
                faults: Faults::default(),
            };
            let mut state = ArmMessage { stamp_s, reading };
            mean.subtract(0.4, &mut state);
            state.reading.torques_nm.unwrap()[1]
        };
        (0..40).map(torque).collect()
    }

    #[test]
    fn the_arms_weight_is_not_a_torque_and_a_push_is() {
        assert!(torques(|_| 9.0).iter().all(|torque| torque.abs() < 1e-12));
        // The weight of a stretched arm that rises within 2 s: 4.5 N m/s.
        let rising = torques(|now_s| 4.5 * now_s.min(2.0));
        assert!(rising.iter().all(|torque| torque.abs() < 2.0), "{rising:?}");
        let pushed = torques(|now_s| if now_s < 2.0 { 9.0 } else { 15.0 });
        assert!(pushed[19] == 0.0 && pushed[20] > 4.0 && pushed[39] < 0.5, "{pushed:?}");
    }
}
