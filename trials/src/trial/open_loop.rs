//! Motions that are executed without observing the objects.

use glam::DVec3;
use tandem_core::{ArmIndex, Stream, episode_rng};
use tandem_kinematics::{ArmWaypoint, Joints, Motion, Reason, Refusal, Waypoint};

use crate::trial::coordination::coordinated;
use crate::trial::copies::FRICTIONS;
use crate::trial::noise::add_noise;
use crate::trial::outcome::{FailureCause, MotionRefusal};
use crate::trial::rehearsal::{Rollout, TrialStart};
use crate::trial::rig::TrialRig;
use crate::trial::robustness::Variants;
use crate::trial::runner::{REST_S, STEP_GAP_M, TrialExecution, TrialRunner};
use crate::trial::{ActionSource, TrialError};

/// Steps of a hand that withdraws: two of them up, by [`LIFT_M`], and the others away.
const N_WITHDRAWAL_STEPS: usize = 10;
/// A rehearsal is tried on the copies of the pair if it fails in at most this many more variants of the training world
/// than the best one.
const VARIANTS_MARGIN: usize = 2;
/// No further rehearsal is needed if one succeeds on all copies of the pair and fails in at most this many variants of
/// the training world.
const ENOUGH_VARIANTS: usize = 1;
/// The number of failed variants of a rehearsal that was not in the training world.
const UNTRIED: usize = usize::MAX;
/// Height by which a hand that withdraws first rises, metres.
const LIFT_M: f64 = 0.06;

/// A motion that was planned before its execution.
#[derive(Clone)]
pub(super) struct PlannedMotion {
    /// The waypoints of the tools; empty if an arm cannot reach them.
    pub(super) waypoints: Vec<Waypoint>,
    /// The motion through them, or the reason why there is none.
    pub(super) motion: Result<Motion, FailureCause>,
    /// The final distances of the objects from their goals in the rehearsal, metres.
    pub(super) rehearsed_m: Vec<f64>,
    pub(super) n_steps: usize,
    /// Whether the time limit has passed in the rehearsal.
    pub(super) timed_out: bool,
}

/// A motion that may be executed.
struct Candidate {
    /// The number of copies of the pair on which it fails.
    n_failed_copies: usize,
    /// The number of variants of the training world in which the actions of its rehearsal fail, or [`UNTRIED`].
    n_failed_variants: usize,
    planned: PlannedMotion,
}

impl TrialRunner {
    /// Plans the most robust of several rehearsals: the one that fails on the fewest copies of the pair. If none of
    /// those in the training world succeeds on all copies, the policy also plays, with noise, in the closed loop on
    /// copies.
    pub(super) fn rehearse(
        &self,
        start: &TrialStart,
        joint_angles: &[Joints],
        policy: &mut dyn ActionSource,
    ) -> Result<PlannedMotion, TrialError> {
        let rollout = self.rehearsal.play(policy)?;
        let Some(variants) = self.rehearsal.variants() else {
            return Ok(self.planned(&rollout, start, joint_angles));
        };
        let mut noise = episode_rng(self.config.seed, start.number, Stream::Exploration);
        let mut noisy = |observation: &[f32], goal: &[f32], action: &mut [f32]| {
            policy.act(observation, goal, action);
            add_noise(&mut noise, action);
        };
        let mut best =
            self.rehearse_in_training_world(start, joint_angles, &rollout, variants, &mut noisy)?;
        for friction in FRICTIONS.into_iter().cycle().take(self.config.n_rehearsals as usize) {
            let Some(max_failed) = max_failed_copies(best.as_ref(), UNTRIED) else { break };
            let planned = self.rehearse_on_copy(start, joint_angles, friction, &mut noisy)?;
            if planned.motion.is_err() {
                continue;
            }
            if let Some(n_failed_copies) =
                self.n_failed_copies(start, joint_angles, &planned, max_failed)?
            {
                best = Some(Candidate { n_failed_copies, n_failed_variants: UNTRIED, planned });
            }
        }
        Ok(best.map_or_else(|| self.planned(&rollout, start, joint_angles), |best| best.planned))
    }

    /// Returns the most robust of the configured number of episodes in the training world: the one that fails on the
    /// fewest copies of the pair and, of those, in the fewest variants of the training world. The actions of all but
    /// the first episode, `first`, have noise. Returns `None` if the check refuses all motions.
    fn rehearse_in_training_world(
        &self,
        start: &TrialStart,
        joint_angles: &[Joints],
        first: &Rollout,
        variants: &Variants,
        noisy: &mut dyn ActionSource,
    ) -> Result<Option<Candidate>, TrialError> {
        let mut fewest_variants = usize::MAX;
        let mut best: Option<Candidate> = None;
        for idx in 0..self.config.n_rehearsals {
            let rollout = match idx {
                0 => first.clone(),
                _ => self.rehearsal.play(noisy)?,
            };
            let max_failed = fewest_variants.saturating_add(VARIANTS_MARGIN);
            let Some(n_failed_variants) = variants.n_failed(&rollout, max_failed)? else {
                continue;
            };
            fewest_variants = fewest_variants.min(n_failed_variants);
            let Some(max_failed) = max_failed_copies(best.as_ref(), n_failed_variants) else {
                continue;
            };
            let planned = self.planned(&rollout, start, joint_angles);
            if planned.motion.is_err() {
                continue;
            }
            let n_failed_copies =
                self.n_failed_copies(start, joint_angles, &planned, max_failed)?;
            let Some(n_failed_copies) = n_failed_copies else { continue };
            best = Some(Candidate { n_failed_copies, n_failed_variants, planned });
            if n_failed_copies == 0 && n_failed_variants <= ENOUGH_VARIANTS {
                break;
            }
        }
        Ok(best)
    }

    /// Converts an episode in the training world to a motion.
    fn planned(
        &self,
        rollout: &Rollout,
        start: &TrialStart,
        joint_angles: &[Joints],
    ) -> PlannedMotion {
        let mut openings = vec![start.opening_m; start.hands.len()];
        let mut waypoints = vec![self.waypoint(&start.hands, &openings, joint_angles)];
        for step in &rollout.steps {
            for (arm, opening_m) in openings.iter_mut().enumerate() {
                let action = &step.action[self.config.layout.action_of(ArmIndex(arm))];
                *opening_m = self.mapping.opening_after(*opening_m, step.openings_m[arm], action);
            }
            let hands: Vec<DVec3> =
                step.hands.iter().map(|hand| self.mapping.reachable_hand(*hand)).collect();
            waypoints.push(self.waypoint(&hands, &openings, joint_angles));
        }
        let (waypoints, motion) = match waypoints.into_iter().collect() {
            Ok(waypoints) => self.blind_motion(waypoints, joint_angles),
            Err(cause) => (Vec::new(), Err(cause)),
        };
        PlannedMotion {
            waypoints,
            motion,
            rehearsed_m: rollout.goal_distances_m.clone(),
            n_steps: rollout.steps.len(),
            timed_out: false,
        }
    }

    /// Executes a motion that was planned before.
    pub(super) fn open_loop(
        &self,
        rig: &mut TrialRig<'_>,
        start: &TrialStart,
        planned: PlannedMotion,
    ) -> TrialExecution {
        let PlannedMotion { waypoints, motion, rehearsed_m, n_steps, timed_out } = planned;
        let ended = motion.and_then(|motion| rig.play(motion, self.config.speed));
        let mut n_in_success = 0;
        let n_judged = self.task.success_steps();
        let ended = ended.and_then(|()| {
            (0..n_judged).try_for_each(|_| {
                rig.wait(REST_S / n_judged as f64)?;
                n_in_success = if self.is_success(rig, start) { n_in_success + 1 } else { 0 };
                Ok(())
            })
        });
        TrialExecution {
            ended,
            n_in_success,
            n_steps,
            n_shortened: 0,
            rehearsed_m: Some(rehearsed_m),
            timed_out,
            waypoints,
        }
    }

    /// Plans and checks the motion through `waypoints` from `joint_angles` (radians). If that brings the arms too
    /// close, one waits for the other, unless both hold one object. Returns the waypoints of the motion as well.
    pub(super) fn blind_motion(
        &self,
        waypoints: Vec<Waypoint>,
        joint_angles: &[Joints],
    ) -> (Vec<Waypoint>, Result<Motion, FailureCause>) {
        let motion = self.motion(&waypoints, joint_angles, &self.check);
        let Err(FailureCause::Refused(MotionRefusal::Check(Refusal {
            reason: Reason::ArmsGap(..),
            ..
        }))) = motion
        else {
            return (waypoints, motion);
        };
        if self.task.shares_object() {
            return (waypoints, motion);
        }
        for path in [waypoints.clone(), self.with_withdrawals(&waypoints, joint_angles)] {
            let Some(waypoints) = coordinated(self.mapping.cell(), &path, joint_angles, STEP_GAP_M)
            else {
                continue;
            };
            let motion = self.motion(&waypoints, joint_angles, &self.check);
            if motion.is_ok() {
                return (waypoints, motion);
            }
        }
        (waypoints, motion)
    }

    /// Returns `waypoints` with room for one arm to pass while the other waits: each hand withdraws and returns before
    /// it starts and, in tasks without grasping, withdraws at the end.
    fn with_withdrawals(&self, waypoints: &[Waypoint], joint_angles: &[Joints]) -> Vec<Waypoint> {
        let (Some(first), Some(last)) = (waypoints.first(), waypoints.last()) else {
            return waypoints.to_vec();
        };
        let away = self.withdrawal(first, joint_angles);
        let back = away.iter().rev().skip(1).cloned().chain([first.clone()]);
        let mut path = vec![first.clone()];
        path.extend(away.iter().cloned().chain(back));
        path.extend(waypoints[1..].iter().cloned());
        if !self.config.layout.task.grasps() {
            path.extend(self.withdrawal(last, joint_angles));
        }
        path
    }

    /// Returns the waypoints after `from` in which all hands go up, and then to where they are out of the way, as far
    /// as the arms reach.
    fn withdrawal(&self, from: &Waypoint, joint_angles: &[Joints]) -> Vec<Waypoint> {
        let path = |arm: usize, waypoint: &ArmWaypoint| -> Vec<ArmWaypoint> {
            let index = ArmIndex(arm);
            let placed = &self.mapping.cell().arms[arm];
            let target = placed.target(&waypoint.tool_in_world_m);
            let Ok(solution) = placed.model.inverse_kinematics(&target, &joint_angles[arm]) else {
                return vec![*waypoint; N_WITHDRAWAL_STEPS];
            };
            let hand = self.mapping.hand_in_arm(index, &solution.angles);
            let above = self.mapping.reachable_hand(hand + DVec3::Z * LIFT_M);
            let target = self.mapping.withdrawn_hand(hand);
            let mut last = *waypoint;
            let step = |step: usize| {
                let hand = match step {
                    0 => 0.5 * (hand + above),
                    1 => above,
                    _ => above.lerp(target, (step - 1) as f64 / (N_WITHDRAWAL_STEPS - 2) as f64),
                };
                if let Ok((tool, _)) = self.mapping.tool_in_world(index, hand, &solution.angles) {
                    last.tool_in_world_m = tool.into();
                }
                last
            };
            (0..N_WITHDRAWAL_STEPS).map(step).collect()
        };
        let paths: Vec<Vec<ArmWaypoint>> =
            from.iter().enumerate().map(|(arm, waypoint)| path(arm, waypoint)).collect();
        (0..N_WITHDRAWAL_STEPS).map(|step| paths.iter().map(|path| path[step]).collect()).collect()
    }
}

/// Returns the largest number of copies on which a motion may fail that is to be preferred to `best`, or `None` if
/// there is no such number.
fn max_failed_copies(best: Option<&Candidate>, n_failed_variants: usize) -> Option<usize> {
    match best {
        None => Some(usize::MAX),
        Some(best) if n_failed_variants < best.n_failed_variants => Some(best.n_failed_copies),
        Some(best) => best.n_failed_copies.checked_sub(1),
    }
}

#[cfg(test)]
mod tests {
    use tandem_core::Task;

    use super::*;
    use crate::trial::{TrialMode, test_config};

    fn runner(task: Task) -> TrialRunner {
        TrialRunner::new(test_config(task, TrialMode::OpenLoop, 1)).unwrap()
    }

    #[test]
    fn a_motion_is_preferred_if_it_fails_on_fewer_copies_or_on_as_many_and_in_fewer_variants() {
        let planned = PlannedMotion {
            waypoints: Vec::new(),
            motion: Err(FailureCause::TimedOut),
            rehearsed_m: Vec::new(),
            n_steps: 0,
            timed_out: false,
        };
        let best = |n_failed_copies, n_failed_variants| Candidate {
            n_failed_copies,
            n_failed_variants,
            planned: planned.clone(),
        };
        assert_eq!(max_failed_copies(None, 9), Some(usize::MAX));
        assert_eq!(max_failed_copies(Some(&best(2, 3)), 2), Some(2));
        assert_eq!(max_failed_copies(Some(&best(2, 3)), 3), Some(1));
        assert_eq!(max_failed_copies(Some(&best(0, 3)), 2), Some(0));
        assert_eq!(max_failed_copies(Some(&best(0, 3)), 3), None);
    }

    #[test]
    fn a_gripper_opens_from_the_size_of_the_object_that_it_holds() {
        let runner = runner(Task::SharedPickAndPlace);
        let after = |commanded_m, input| {
            runner.mapping.opening_after(commanded_m, 0.028, &[0.0, 0.0, 0.0, input])
        };
        assert!(after(0.0, 0.5) > 0.028, "opens in one step");
        assert!(after(0.020, -0.5) < 0.020, "presses harder");
        assert!((after(0.028, -1.0) - (0.028 - 0.062 * 0.25)).abs() < 1e-9);
    }

    #[test]
    fn arms_whose_paths_end_in_each_other_withdraw() {
        let runner = runner(Task::SharedPush);
        let cell = runner.mapping.cell();
        let near = cell.ready(0.2).unwrap();
        let at_share = |share: f64| {
            let hand = DVec3::new(0.18 * share, 0.0, 0.05);
            runner.waypoint(&[hand, hand], &[0.0; 2], &near).unwrap()
        };
        let waypoints: Vec<Waypoint> =
            (0..=6).map(|step| at_share(f64::from(step) / 6.0)).collect();
        let refused = runner.motion(&waypoints, &near, &runner.check);
        assert!(matches!(refused, Err(FailureCause::Refused(MotionRefusal::Check(_)))));
        assert_eq!(coordinated(cell, &waypoints, &near, STEP_GAP_M), None, "waiting is not enough");
        let (path, motion) = runner.blind_motion(waypoints.clone(), &near);
        assert!(motion.is_ok(), "{motion:?}");
        for (arm, reached) in waypoints[6].iter().enumerate() {
            assert!(path.iter().any(|waypoint| waypoint[arm] == *reached), "arm {arm}");
        }
    }
}
