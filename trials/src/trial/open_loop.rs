//! Motions that are executed without observing the objects.

use tandem_core::ArmIndex;
use tandem_kinematics::{Joints, Motion, Reason, Refusal, Waypoint};

use crate::trial::coordination::coordinated;
use crate::trial::outcome::{FailureCause, MotionRefusal};
use crate::trial::rehearsal::TrialStart;
use crate::trial::rig::TrialRig;
use crate::trial::runner::{REST_S, STEP_GAP_M, TrialExecution, TrialRunner};
use crate::trial::{ActionSource, TrialError};

/// A motion that was planned before its execution.
pub(super) struct PlannedMotion {
    pub(super) waypoints: Result<Vec<Waypoint>, FailureCause>,
    /// The final distances of the objects from their goals in the rehearsal, metres.
    pub(super) rehearsed_m: Vec<f64>,
    pub(super) n_steps: usize,
}

impl TrialRunner {
    /// Converts the policy's episode in the training world to waypoints.
    pub(super) fn rehearse(
        &mut self,
        start: &TrialStart,
        at: &[Joints],
        policy: &mut dyn ActionSource,
    ) -> Result<PlannedMotion, TrialError> {
        let rollout = self.rehearsal.play(policy)?;
        let mut openings = vec![start.opening_m; start.hands.len()];
        let mut waypoints = vec![self.waypoint(&start.hands, &openings, at)];
        for step in &rollout.steps {
            for (arm, opening_m) in openings.iter_mut().enumerate() {
                let action = &step.action[self.config.layout.action_of(ArmIndex(arm))];
                *opening_m = self.mapping.opening_after(*opening_m, action);
            }
            waypoints.push(self.waypoint(&step.hands, &openings, at));
        }
        Ok(PlannedMotion {
            waypoints: waypoints.into_iter().collect(),
            rehearsed_m: rollout.goal_distances_m,
            n_steps: rollout.steps.len(),
        })
    }

    /// Executes a motion that was planned before.
    pub(super) fn open_loop(
        &self,
        rig: &mut TrialRig<'_>,
        start: &TrialStart,
        at: &[Joints],
        planned: PlannedMotion,
    ) -> TrialExecution {
        let (waypoints, motion) = match planned.waypoints {
            Ok(waypoints) => self.blind_motion(waypoints, at),
            Err(cause) => (Vec::new(), Err(cause)),
        };
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
            n_steps: planned.n_steps,
            n_shortened: 0,
            rehearsed_m: Some(planned.rehearsed_m),
            timed_out: false,
            waypoints,
        }
    }

    /// Plans and checks the motion through `waypoints` from joint angles `at` (radians). If that brings the arms too close, one
    /// waits for the other, unless both hold one object. Returns the waypoints of the motion as well.
    fn blind_motion(
        &self,
        waypoints: Vec<Waypoint>,
        at: &[Joints],
    ) -> (Vec<Waypoint>, Result<Motion, FailureCause>) {
        let motion = self.motion(&waypoints, at, &self.check);
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
        match coordinated(self.mapping.cell(), &waypoints, at, STEP_GAP_M) {
            Some(waypoints) => {
                let motion = self.motion(&waypoints, at, &self.check);
                (waypoints, motion)
            }
            None => (waypoints, motion),
        }
    }
}
