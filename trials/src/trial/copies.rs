//! Copies of the pair, on which motions without feedback are rehearsed and tried.
//!
//! The training world has a free hand; on the arms the gripper tilts with the joints and has two narrow fingers. Such a
//! motion is therefore executed on copies of the pair before one is chosen. None of them has the friction of the pair.
//! Their noise and latencies are as large as the pair's, but have other seeds. The policy rehearses without noise.

use tandem_kinematics::Joints;

use crate::simulated::{CameraConfig, GripperConfig, SimulatedConfig, SimulatedPair};
use crate::trial::closed_loop::ClosedLoop;
use crate::trial::open_loop::PlannedMotion;
use crate::trial::outcome::{FailureCause, ObjectResult};
use crate::trial::rehearsal::TrialStart;
use crate::trial::rig::{Goals, TrialRig};
use crate::trial::robustness::USED_TOLERANCE_SHARE;
use crate::trial::runner::TrialRunner;
use crate::trial::{ActionSource, NoObserver, TrialError};

/// The friction of each copy, as a share of the pair's.
pub(super) const FRICTIONS: [f32; 8] = [0.8, 1.2, 0.9, 1.1, 0.85, 1.15, 0.95, 1.05];
/// The noise on copy N of a trial, counted from 1, is that of a trial whose number is larger by N times this. No trial
/// has such a number.
const NOISE_STRIDE: u64 = 1 << 48;

impl TrialRunner {
    /// Executes a planned motion blindly on the copies of the pair. Returns the number of those on which it fails, or
    /// `None` if they are more than `max_failed`.
    pub(super) fn n_failed_copies(
        &self,
        start: &TrialStart,
        joint_angles: &[Joints],
        planned: &PlannedMotion,
        max_failed: usize,
    ) -> Result<Option<usize>, TrialError> {
        let mut n_failed = 0;
        let noises = (1..).map(|copy: u64| start.number.wrapping_add(copy * NOISE_STRIDE));
        for (friction, noise) in FRICTIONS.into_iter().zip(noises) {
            let simulated = with_friction(&self.config.simulated, friction);
            let pair = self.pair(start, joint_angles, noise, &simulated);
            n_failed += usize::from(!self.succeeds_on(pair, start, planned)?);
            if n_failed > max_failed {
                return Ok(None);
            }
        }
        Ok(Some(n_failed))
    }

    fn succeeds_on(
        &self,
        pair: SimulatedPair,
        start: &TrialStart,
        planned: &PlannedMotion,
    ) -> Result<bool, TrialError> {
        let report = self.on(pair, |rig| {
            let initial = rig.pair().objects();
            let execution = self.open_loop(rig, start, planned.clone());
            self.report(start.number, start, &initial, rig, execution)
        })?;
        let near_m = USED_TOLERANCE_SHARE * self.tolerance_m();
        let is_near = |object: &ObjectResult| object.end.distance(object.goal) <= near_m;
        Ok(report.cause.is_none() && report.objects.iter().all(is_near))
    }

    /// Plans the motion of an episode in the closed loop on a copy of the pair with `friction` times its friction and
    /// without noise.
    pub(super) fn rehearse_on_copy(
        &self,
        start: &TrialStart,
        joint_angles: &[Joints],
        friction: f32,
        policy: &mut dyn ActionSource,
    ) -> Result<PlannedMotion, TrialError> {
        let simulated = without_noise(&with_friction(&self.config.simulated, friction));
        let pair = self.pair(start, joint_angles, start.number, &simulated);
        let (execution, ends) = self.on(pair, |rig| {
            let execution = ClosedLoop::new(self, rig, start, joint_angles, policy).run();
            (execution, rig.pair().objects())
        })?;
        let (waypoints, motion) = match execution.ended {
            Ok(()) => self.blind_motion(execution.waypoints, joint_angles),
            Err(cause) => (Vec::new(), Err(FailureCause::NotRehearsed(Box::new(cause)))),
        };
        Ok(PlannedMotion {
            waypoints,
            motion,
            rehearsed_m: self.goal_distances_m(&ends, start),
            n_steps: execution.n_steps,
            timed_out: execution.timed_out,
        })
    }

    /// Executes `run` on a copy of the pair.
    fn on<T>(
        &self,
        pair: SimulatedPair,
        run: impl FnOnce(&mut TrialRig<'_>) -> T,
    ) -> Result<T, TrialError> {
        let (cell, mut observer) = (self.mapping.cell().clone(), NoObserver);
        let mut rig = TrialRig::new(cell, pair, Goals::default(), &mut observer)?;
        Ok(run(&mut rig))
    }
}

/// Returns the configuration of a pair with `friction` times the friction.
fn with_friction(simulated: &SimulatedConfig, friction: f32) -> SimulatedConfig {
    SimulatedConfig {
        gripper: GripperConfig {
            pad_friction: friction * simulated.gripper.pad_friction,
            ..simulated.gripper
        },
        table_friction: friction * simulated.table_friction,
        ..simulated.clone()
    }
}

/// Returns the configuration of a pair without noise and with the shortest latency.
fn without_noise(simulated: &SimulatedConfig) -> SimulatedConfig {
    SimulatedConfig {
        latency_periods: [1, 1],
        angle_noise_rad: 0.0,
        rate_noise_radps: 0.0,
        torque_noise_nm: 0.0,
        camera: CameraConfig {
            position_noise_m: 0.0,
            orientation_noise_rad: 0.0,
            ..simulated.camera
        },
        ..simulated.clone()
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;
    use tandem_core::Task;

    use super::*;
    use crate::trial::runner::start_angles;
    use crate::trial::{TrialMode, test_config};

    #[test]
    fn a_motion_succeeds_on_the_copies_only_if_it_brings_the_objects_to_their_goals() {
        let config = test_config(Task::SharedPush, TrialMode::OpenLoop, 1);
        let mut runner = TrialRunner::new(config).unwrap();
        let start = runner.start(0).unwrap();
        let near = runner.mapping.cell().ready(0.2).unwrap();
        let tools = |hands: &[DVec3]| runner.waypoint(hands, &[0.0; 2], &near).unwrap();
        let raised: Vec<DVec3> = start.hands.iter().map(|hand| *hand + DVec3::Z * 0.02).collect();
        let waypoints = vec![tools(&start.hands), tools(&raised)];
        let joint_angles = start_angles(&runner.mapping, &start).unwrap();
        let (waypoints, motion) = runner.blind_motion(waypoints, &joint_angles);
        let (rehearsed_m, n_steps, timed_out) = (vec![0.0; 2], 1, false);
        let idle = PlannedMotion { waypoints, motion, rehearsed_m, n_steps, timed_out };
        let n_failed = |start, max_failed| {
            runner.n_failed_copies(start, &joint_angles, &idle, max_failed).unwrap()
        };
        assert_eq!(n_failed(&start, usize::MAX), Some(FRICTIONS.len()));
        assert_eq!(n_failed(&start, 1), None);
        let solved = TrialStart { goals: start.objects.clone(), ..start.clone() };
        assert_eq!(n_failed(&solved, 0), Some(0));
    }

    #[test]
    fn a_stop_on_the_copy_is_not_one_of_the_pair() {
        let mut config = test_config(Task::SharedPush, TrialMode::Twin, 1);
        // Joints that hardly follow their commands.
        config.simulated.lag_s = 100.0;
        let mut runner = TrialRunner::new(config).unwrap();
        let mut policy = |_: &[f32], _: &[f32], action: &mut [f32]| action.fill(0.5);
        let report = runner.run(0, &mut policy, &mut NoObserver).unwrap();
        let Some(FailureCause::NotRehearsed(cause)) = report.cause else {
            panic!("{:?}", report.cause)
        };
        assert_eq!(cause.name(), "stopped");
        assert!(report.objects.iter().all(|object| object.start.distance(object.end) < 1e-3));
    }
}
