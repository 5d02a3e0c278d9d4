//! Runs single trials.

use glam::DVec3;
use tandem_core::{ArmIndex, TaskSpec};
use tandem_kinematics::trajectory::DEFAULT_RATE_HZ;
use tandem_kinematics::{
    ArmWaypoint, CheckSettings, Joints, Motion, PlacedArm, PlanError, PlanSettings, ReachError,
    Waypoint, check, plan,
};
use tandem_sim::SimError;

use crate::simulated::{Block, ObjectPose, SimulatedConfig, SimulatedPair, single};
use crate::trial::closed_loop::ClosedLoop;
use crate::trial::mapping::Mapping;
use crate::trial::outcome::{
    FailureCause, MotionRefusal, ObjectResult, contact_failure, object_failure,
};
use crate::trial::rehearsal::{Rehearsal, TrialStart};
use crate::trial::rig::{Goals, TrialRig};
use crate::trial::shared_object::placed;
use crate::trial::{
    ActionSource, ObjectPositions, TrialConfig, TrialError, TrialMode, TrialObserver, TrialReport,
};
use tandem_bridge::work_cell::{check_settings, mico_cell_of};

/// Time for objects to come to rest before they are evaluated, seconds.
pub(super) const REST_S: f64 = 0.5;
/// Room between the arms that a step of the closed loop keeps, metres: more than the check requires, so that the next
/// step can start.
pub(super) const STEP_GAP_M: f64 = 0.025;
/// Angle between a joint of an arm that starts a trial and the end of the joint's range, radians: a little more than
/// the executor demands of motions.
const RANGE_ROOM_RAD: f64 = 0.02;
/// Friction of the twin, as a share of the pair's.
const TWIN_FRICTION: f32 = 0.8;

/// Runs trials that differ in their numbers only.
pub struct TrialRunner {
    pub(super) config: TrialConfig,
    /// The task of the policy.
    pub(super) task: TaskSpec,
    pub(super) mapping: Mapping,
    pub(super) rehearsal: Rehearsal,
    pub(super) check: CheckSettings,
    /// The check of a step of the closed loop.
    pub(super) step_check: CheckSettings,
}

/// The execution of a trial up to its end.
pub(super) struct TrialExecution {
    pub(super) ended: Result<(), FailureCause>,
    pub(super) n_steps: usize,
    pub(super) n_shortened: usize,
    pub(super) rehearsed_m: Option<Vec<f64>>,
    pub(super) timed_out: bool,
    /// The number of last judgements, up to the end, that found the task's goal achieved and its conditions met.
    pub(super) n_in_success: usize,
    /// The waypoints of the tools.
    pub(super) waypoints: Vec<Waypoint>,
}

impl TrialRunner {
    /// Prepares trials of `config`.
    ///
    /// # Errors
    /// Returns an error if there is no training world for its layout and blocks.
    pub fn new(config: TrialConfig) -> Result<Self, SimError> {
        let mut cell = mico_cell_of(config.layout.task.world());
        cell.arms.truncate(config.layout.n_arms);
        let trained_half_m = config.trained_half_m;
        let mut rehearsal = Rehearsal::new(config.layout, &config.block, trained_half_m)?;
        if config.mode == TrialMode::OpenLoop && config.n_rehearsals > 1 {
            rehearsal.add_variants()?;
        }
        let half_m = rehearsal.shared_object().map(|shared| shared.grasped_half_m());
        let block = Block { half_m: half_m.unwrap_or(config.block.half_m), ..config.block };
        let config = TrialConfig { block, ..config };
        Ok(Self {
            mapping: Mapping::new(
                cell,
                config.layout,
                rehearsal.hand(),
                &config.block,
                trained_half_m,
            ),
            rehearsal,
            task: config.layout.into(),
            check: check_settings(),
            step_check: CheckSettings { arms_gap_m: STEP_GAP_M, ..check_settings() },
            config,
        })
    }

    /// Carries out trial `number`. A trial that fails is a report with a cause.
    ///
    /// # Errors
    /// Returns an error if there is no room for the blocks, the arms cannot reach the start or are not reset, or the
    /// training world fails.
    pub fn run(
        &mut self,
        number: u64,
        policy: &mut dyn ActionSource,
        observer: &mut dyn TrialObserver,
    ) -> Result<TrialReport, TrialError> {
        let start = self.start(number)?;
        let joint_angles = start_angles(&self.mapping, &start)?;
        let planned = match self.config.mode {
            TrialMode::OpenLoop => Some(self.rehearse(&start, &joint_angles, policy)?),
            TrialMode::Twin => {
                Some(self.rehearse_on_copy(&start, &joint_angles, TWIN_FRICTION, policy)?)
            }
            TrialMode::ClosedLoop => None,
        };
        let pair = self.pair(&start, &joint_angles, number, &self.config.simulated);
        let initial: Vec<ObjectPose> = pair.objects();
        let at_m = self.in_world(&start.goals);
        let goals = Goals { at_m, tolerance_m: self.task.tolerance() };
        let mut rig = TrialRig::new(self.mapping.cell().clone(), pair, goals, observer)?;
        let execution = match planned {
            Some(motion) => self.open_loop(&mut rig, &start, motion),
            None => ClosedLoop::new(self, &mut rig, &start, &joint_angles, policy).run(),
        };
        Ok(self.report(number, &start, &initial, &rig, execution))
    }

    pub(super) fn report(
        &self,
        number: u64,
        start: &TrialStart,
        initial: &[ObjectPose],
        rig: &TrialRig<'_>,
        execution: TrialExecution,
    ) -> TrialReport {
        let in_arm = |arm: usize, at_m: DVec3| self.mapping.object_in_arm(ArmIndex(arm), at_m);
        let ends = rig.pair().objects();
        let objects: Vec<ObjectResult> = (0..ends.len())
            .map(|arm| ObjectResult {
                start: in_arm(arm, initial[arm].at_m),
                goal: start.goals[arm],
                end: in_arm(arm, ends[arm].at_m),
                highest_m: in_arm(arm, DVec3::Z * rig.highest_m[arm]).z,
            })
            .collect();
        let goals = self.in_world(&start.goals);
        let positions = (0..ends.len())
            .map(|arm| ObjectPositions {
                start: initial[arm].at_m,
                goal: goals[arm],
                end: ends[arm].at_m,
            })
            .collect();
        let tolerance_m = self.tolerance_m();
        let unreached = || {
            let task = self.config.layout.task;
            object_failure(task, &objects, tolerance_m, execution.timed_out)
        };
        let too_short = execution.n_in_success < self.task.success_steps();
        let unmet = || too_short.then_some(FailureCause::ConditionUnmet);
        let cause = contact_failure(rig.touched)
            .or(execution.ended.err())
            .or_else(unreached)
            .or_else(unmet);
        TrialReport {
            number,
            cause,
            positions,
            tolerance_m,
            rehearsed_m: execution.rehearsed_m,
            duration_s: rig.now_s(),
            n_steps: execution.n_steps,
            n_shortened: execution.n_shortened,
            touched: rig.touched,
            arms_gap_m: rig.arms_gap_m,
            table_gap_m: rig.table_gap_m,
            path: rig.path.clone(),
            waypoints: execution.waypoints,
            objects,
        }
    }

    /// Returns the distance of an object from its goal up to which the goal counts as achieved, metres.
    pub(super) fn tolerance_m(&self) -> f64 {
        self.task.tolerance().into()
    }

    /// Returns for each arm the distance from its object to its goal, metres.
    pub(super) fn goal_distances_m(&self, objects: &[ObjectPose], start: &TrialStart) -> Vec<f64> {
        let distance_m = |(arm, (object, goal)): (usize, (&ObjectPose, &DVec3))| {
            self.mapping.object_in_arm(ArmIndex(arm), object.at_m).distance(*goal)
        };
        objects.iter().zip(&start.goals).enumerate().map(distance_m).collect()
    }

    /// Returns whether every object is at its goal, and every arm meets the task's other conditions, in truth.
    pub(super) fn is_success(&self, rig: &TrialRig<'_>, start: &TrialStart) -> bool {
        let objects = rig.pair().objects();
        self.config.layout.arms().all(|arm| {
            let (angles, opening) = (rig.pair().angles(arm), rig.pair().opening(arm));
            let now = self.mapping.observe(arm, angles, opening, DVec3::ZERO, &objects[arm.0]);
            let mut observation = vec![0.0; self.config.layout.n_observation()];
            let numbers = &mut observation[self.config.layout.observation_of(arm)];
            self.mapping.write_observation(&now, &now, numbers);
            (now.object - start.goals[arm.0]).length() <= self.tolerance_m()
                && self.task.arm_meets_conditions(arm, &observation)
        })
    }

    /// Plans the motion through `waypoints` from `joint_angles` (radians) and checks it with `settings`.
    pub(super) fn motion(
        &self,
        waypoints: &[Waypoint],
        joint_angles: &[Joints],
        settings: &CheckSettings,
    ) -> Result<Motion, FailureCause> {
        let cell = self.mapping.cell();
        let planned = plan(cell, waypoints, joint_angles, &PlanSettings::default());
        let trajectory =
            planned.map_err(|error| FailureCause::Refused(MotionRefusal::Plan(error)))?;
        let motion = trajectory.sampled(DEFAULT_RATE_HZ);
        let first: Vec<Joints> = motion.arms.iter().map(|samples| samples[0].angles).collect();
        check(cell, &motion, &first, settings)
            .map_err(|refusal| FailureCause::Refused(MotionRefusal::Check(refusal)))?;
        Ok(motion)
    }

    /// Returns the waypoint for end effectors at `hands` (arm frames, metres), near joint angles `near` (radians).
    pub(super) fn waypoint(
        &self,
        hands: &[DVec3],
        openings_m: &[f64],
        near: &[Joints],
    ) -> Result<Waypoint, FailureCause> {
        let arm_waypoint = |arm: usize| {
            let tool = self.mapping.tool_in_world(ArmIndex(arm), hands[arm], &near[arm]);
            let (tool_in_world_m, _) = tool.map_err(|source| unreachable(ArmIndex(arm), source))?;
            Ok(ArmWaypoint {
                tool_in_world_m: tool_in_world_m.into(),
                gripper_opening: self.mapping.opening(openings_m[arm]),
            })
        };
        (0..hands.len()).map(arm_waypoint).collect()
    }

    /// Draws the start of trial `number`, at which the arms are as far apart as the check requires.
    pub(super) fn start(&mut self, number: u64) -> Result<TrialStart, TrialError> {
        let Self { mapping, check, .. } = self;
        let is_free = |start: &TrialStart| {
            // An arm that cannot reach the start is reported later.
            start_angles(mapping, start).map_or(true, |joint_angles| {
                let mut arms = mapping.cell().arms.iter().zip(&joint_angles);
                mapping.cell().gaps(&joint_angles).arms_m >= check.arms_gap_m
                    && arms.all(|(placed, angles)| has_range(placed, angles))
            })
        };
        self.rehearsal.start(self.config.seed, number, is_free)
    }

    /// Converts positions of objects or goals, one of each arm, from the arm frames to the world frame, metres.
    fn in_world(&self, in_arm: &[DVec3]) -> Vec<DVec3> {
        let point =
            |(arm, in_arm): (usize, &DVec3)| self.mapping.object_in_world(ArmIndex(arm), *in_arm);
        in_arm.iter().enumerate().map(point).collect()
    }

    pub(super) fn pair(
        &self,
        start: &TrialStart,
        joint_angles: &[Joints],
        number: u64,
        simulated: &SimulatedConfig,
    ) -> SimulatedPair {
        let block = |(position, yaw_rad): (DVec3, &f64)| {
            let (position, yaw_rad) = (position.as_vec3(), single(*yaw_rad));
            Block { at_m: [position.x, position.y], yaw_rad, ..self.config.block }
        };
        let points = self.in_world(&start.objects);
        let shared = start.shared.clone().map(|shared| placed(shared, &points));
        let blocks = match shared {
            Some(_) => Vec::new(),
            None => points.into_iter().zip(&start.yaws_rad).map(block).collect(),
        };
        let config = SimulatedConfig {
            seed: self.config.seed.wrapping_mul(1_000_003).wrapping_add(number),
            blocks,
            shared,
            ..simulated.clone()
        };
        let opening = self.mapping.opening(start.opening_m);
        SimulatedPair::new(self.mapping.cell().clone(), joint_angles, opening, config)
    }
}

/// Returns whether every joint keeps [`RANGE_ROOM_RAD`] to the ends of its range.
fn has_range(placed: &PlacedArm, angles: &Joints) -> bool {
    placed.model.joints.iter().zip(angles.iter()).all(|(joint, angle)| {
        let [low, high] = joint.range_rad;
        (angle - low).min(high - angle) >= RANGE_ROOM_RAD
    })
}

/// Returns the joint angles of the arms at `start`, radians.
pub(super) fn start_angles(
    mapping: &Mapping,
    start: &TrialStart,
) -> Result<Vec<Joints>, TrialError> {
    let angles = |(arm, hand): (usize, &DVec3)| {
        let near = Joints::new(mapping.cell().arms[arm].model.elbow_up_rad);
        let found = mapping.tool_in_world(ArmIndex(arm), *hand, &near);
        found.map(|(_, angles)| angles).map_err(|source| TrialError::Start { arm, source })
    };
    start.hands.iter().enumerate().map(angles).collect()
}

/// Returns the failure of a motion to a position that `arm` cannot reach.
pub(super) fn unreachable(arm: ArmIndex, source: ReachError) -> FailureCause {
    let error = PlanError::Unreachable { waypoint: 0, arm, source };
    FailureCause::Refused(MotionRefusal::Plan(error))
}

#[cfg(test)]
mod tests {
    use tandem_core::Task;

    use super::*;
    use crate::trial::test_config;

    #[test]
    fn arms_start_where_the_executor_lets_them_move() {
        let config = test_config(Task::SharedPickAndPlace, TrialMode::ClosedLoop, 2);
        let least_rad = tandem_bridge::executor::Settings::default().range_margin_rad;
        let mut runner = TrialRunner::new(config).unwrap();
        for number in 0..50 {
            let start = runner.start(number).unwrap();
            for angles in start_angles(&runner.mapping, &start).unwrap() {
                let elbow = &runner.mapping.cell().arms[0].model.joints[2];
                let [low, high] = elbow.range_rad.map(|end| (angles[2] - end).abs());
                assert!(low.min(high) > least_rad, "trial {number}: {angles:?}");
            }
        }
    }
}
