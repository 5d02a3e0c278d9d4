//! One trial from its start to its end.

use glam::DVec3;
use tandem_core::ArmIndex;
use tandem_kinematics::{
    ArmWayPoint, CheckSettings, Joints, Motion, PlanSettings, WayPoint, check, plan,
};
use tandem_sim::SimError;

use crate::simulated::{
    Block, CameraConfig, GripperConfig, ObjectPose, SimulatedConfig, SimulatedPair,
};
use crate::trial::closed::STEP_GAP_M;
use crate::trial::judge::{Cause, ObjectCourse, RefusedBy, forbidden, judge};
use crate::trial::mapping::Mapping;
use crate::trial::rollout::{Rehearsal, TrialStart};
use crate::trial::stage::Stage;
use crate::trial::{
    Decide, Mode, NoWitness, Places, TrialConfig, TrialError, TrialReport, Witness,
};
use tandem_bridge::work_cell::{check_settings, mico_cell};

/// Samples of a motion per second.
const RATE_HZ: f64 = 100.0;
/// Time for objects to come to rest before they are judged, seconds.
pub(super) const REST_S: f64 = 0.5;
/// How much friction a model of the pair has, as a share of the pair's.
const TWIN_FRICTION: f32 = 0.8;

/// Trials that differ in their numbers only.
pub struct Trials {
    pub(super) config: TrialConfig,
    pub(super) mapping: Mapping,
    rehearsal: Rehearsal,
    pub(super) check: CheckSettings,
    /// For steps of the closed loop.
    pub(super) step_check: CheckSettings,
}

/// How far a trial has come when it ends.
pub(super) struct Course {
    pub(super) ended: Result<(), Cause>,
    pub(super) n_steps: usize,
    pub(super) n_shortened: usize,
    pub(super) rehearsed_m: Option<Vec<f64>>,
    pub(super) time_over: bool,
    /// Where the tools went, or should have gone.
    pub(super) way_points: Vec<WayPoint>,
}

impl Trials {
    /// Prepares trials of `config`.
    ///
    /// # Errors
    /// When there is no training world for its layout and blocks.
    pub fn new(config: TrialConfig) -> Result<Self, SimError> {
        let mut cell = mico_cell();
        cell.arms.truncate(config.layout.n_arms);
        Ok(Self {
            mapping: Mapping::new(cell, config.layout, &config.block),
            rehearsal: Rehearsal::new(config.layout, &config.block)?,
            check: check_settings(),
            step_check: CheckSettings { arms_gap_m: STEP_GAP_M, ..check_settings() },
            config,
        })
    }

    /// Carries out trial `number`.
    ///
    /// # Errors
    /// When it cannot even begin.
    pub fn run(
        &mut self,
        number: u64,
        policy: &mut dyn Decide,
        witness: &mut dyn Witness,
    ) -> Result<TrialReport, TrialError> {
        let start = self.rehearsal.start(self.config.seed, number)?;
        let at = self.start_angles(&start)?;
        let blind = match self.config.mode {
            Mode::OpenLoop => Some(self.rehearse(&start, &at, policy)?),
            Mode::Twin => Some(self.rehearse_on_twin(&start, &at, number, policy)?),
            Mode::ClosedLoop => None,
        };
        let pair = self.pair(&start, &at, number, &self.config.simulated);
        let lain: Vec<ObjectPose> = pair.objects();
        let goals = self.in_world(&start.goals);
        let mut stage = Stage::new(self.mapping.cell().clone(), pair, goals, witness)?;
        let course = match blind {
            Some(blind) => self.open_loop(&mut stage, &at, blind),
            None => self.closed_loop(&mut stage, &start, &at, policy),
        };
        Ok(self.report(number, &start, &lain, &stage, course))
    }

    fn report(
        &self,
        number: u64,
        start: &TrialStart,
        lain: &[ObjectPose],
        stage: &Stage<'_>,
        course: Course,
    ) -> TrialReport {
        let own = |arm: usize, at_m: DVec3| self.mapping.object_in_own(ArmIndex(arm), at_m);
        let ends = stage.pair().objects();
        let objects: Vec<ObjectCourse> = (0..ends.len())
            .map(|arm| ObjectCourse {
                start: own(arm, lain[arm].at_m),
                goal: start.goals[arm],
                end: own(arm, ends[arm].at_m),
                highest_m: own(arm, DVec3::Z * stage.highest_m[arm]).z,
            })
            .collect();
        let goals = self.in_world(&start.goals);
        let places = (0..ends.len())
            .map(|arm| Places { start: lain[arm].at_m, goal: goals[arm], end: ends[arm].at_m })
            .collect();
        let judged = || judge(self.config.layout.task, &objects, course.time_over);
        let cause = forbidden(stage.touched).or(course.ended.err()).or_else(judged);
        TrialReport {
            number,
            cause,
            places,
            rehearsed_m: course.rehearsed_m,
            duration_s: stage.now_s(),
            n_steps: course.n_steps,
            n_shortened: course.n_shortened,
            touched: stage.touched,
            arms_gap_m: stage.arms_gap_m,
            table_gap_m: stage.table_gap_m,
            path: stage.path.clone(),
            way_points: course.way_points,
            objects,
        }
    }

    /// A policy's episode in the training world as way points.
    fn rehearse(
        &mut self,
        start: &TrialStart,
        at: &[Joints],
        policy: &mut dyn Decide,
    ) -> Result<Blind, TrialError> {
        let rollout = self.rehearsal.play(policy)?;
        let mut openings = vec![start.opening_m; start.hands.len()];
        let mut way_points = vec![self.way_point(&start.hands, &openings, at)];
        for step in &rollout.steps {
            for (arm, opening_m) in openings.iter_mut().enumerate() {
                let action = &step.action[self.config.layout.action_of(ArmIndex(arm))];
                *opening_m = self.mapping.opening_after(*opening_m, action);
            }
            way_points.push(self.way_point(&step.hands, &openings, at));
        }
        Ok(Blind {
            way_points: way_points.into_iter().collect(),
            rehearsed_m: rollout.goal_distances_m,
            n_steps: rollout.steps.len(),
        })
    }

    /// The way points of a closed loop on a copy of the pair.
    fn rehearse_on_twin(
        &self,
        start: &TrialStart,
        at: &[Joints],
        number: u64,
        policy: &mut dyn Decide,
    ) -> Result<Blind, TrialError> {
        let pair = self.pair(start, at, number, &twin_of(&self.config.simulated));
        let mut nobody = NoWitness;
        let mut stage = Stage::new(self.mapping.cell().clone(), pair, Vec::new(), &mut nobody)?;
        let course = self.closed_loop(&mut stage, start, at, policy);
        let ends = stage.pair().objects();
        let distance = |(arm, goal): (usize, &DVec3)| {
            (self.mapping.object_in_own(ArmIndex(arm), ends[arm].at_m) - *goal).length()
        };
        Ok(Blind {
            way_points: course.ended.map(|()| course.way_points),
            rehearsed_m: start.goals.iter().enumerate().map(distance).collect(),
            n_steps: course.n_steps,
        })
    }

    /// One motion that was made before.
    fn open_loop(&self, stage: &mut Stage<'_>, at: &[Joints], blind: Blind) -> Course {
        let way_points = blind.way_points.clone().unwrap_or_default();
        let ended = blind
            .way_points
            .and_then(|way_points| self.motion(&way_points, at, &self.check))
            .and_then(|motion| stage.play(motion, self.config.speed))
            .and_then(|()| stage.wait(REST_S));
        Course {
            ended,
            n_steps: blind.n_steps,
            n_shortened: 0,
            rehearsed_m: Some(blind.rehearsed_m),
            time_over: false,
            way_points,
        }
    }

    /// The motion through `way_points` from joint angles `at`, when it passes the check with `settings`.
    pub(super) fn motion(
        &self,
        way_points: &[WayPoint],
        at: &[Joints],
        settings: &CheckSettings,
    ) -> Result<Motion, Cause> {
        let cell = self.mapping.cell();
        let planned = plan(cell, way_points, at, &PlanSettings::default());
        let trajectory = planned.map_err(|error| Cause::Refused(RefusedBy::Plan(error)))?;
        let motion = trajectory.sampled(RATE_HZ);
        let first: Vec<Joints> = motion.arms.iter().map(|samples| samples[0].angles).collect();
        check(cell, &motion, &first, settings)
            .map_err(|refusal| Cause::Refused(RefusedBy::Check(refusal)))?;
        Ok(motion)
    }

    /// The way point for end effectors at `hands` (own frames, metres), near angles `near`.
    pub(super) fn way_point(
        &self,
        hands: &[DVec3],
        openings_m: &[f64],
        near: &[Joints],
    ) -> Result<WayPoint, Cause> {
        let arm_way_point = |arm: usize| {
            let (tool_in_world_m, _) =
                self.mapping.tool_in_world(ArmIndex(arm), hands[arm], &near[arm])?;
            Ok(ArmWayPoint { tool_in_world_m, opening: self.mapping.opening(openings_m[arm]) })
        };
        let arms = (0..hands.len()).map(|arm| {
            arm_way_point(arm).map_err(|source| {
                let arm = ArmIndex(arm);
                Cause::Refused(RefusedBy::Plan(tandem_kinematics::PlanError::Unreachable {
                    way_point: 0,
                    arm,
                    source,
                }))
            })
        });
        arms.collect()
    }

    fn start_angles(&self, start: &TrialStart) -> Result<Vec<Joints>, TrialError> {
        let angles = |(arm, hand): (usize, &DVec3)| {
            let near = Joints::new(self.mapping.cell().arms[arm].model.elbow_up_rad);
            let found = self.mapping.tool_in_world(ArmIndex(arm), *hand, &near);
            found.map(|(_, angles)| angles).map_err(|source| TrialError::Start { arm, source })
        };
        start.hands.iter().enumerate().map(angles).collect()
    }

    fn in_world(&self, own: &[DVec3]) -> Vec<DVec3> {
        let point = |(arm, own): (usize, &DVec3)| self.mapping.object_in_world(ArmIndex(arm), *own);
        own.iter().enumerate().map(point).collect()
    }

    fn pair(
        &self,
        start: &TrialStart,
        at: &[Joints],
        number: u64,
        simulated: &SimulatedConfig,
    ) -> SimulatedPair {
        let block = |at: DVec3| {
            let at = at.as_vec3();
            Block { at_m: [at.x, at.y], ..self.config.block }
        };
        let config = SimulatedConfig {
            seed: self.config.seed.wrapping_mul(1_000_003).wrapping_add(number),
            blocks: self.in_world(&start.objects).into_iter().map(block).collect(),
            ..simulated.clone()
        };
        let opening = self.mapping.opening(start.opening_m);
        SimulatedPair::new(self.mapping.cell().clone(), at, opening, config)
    }
}

/// A motion for arms that do not look.
struct Blind {
    way_points: Result<Vec<WayPoint>, Cause>,
    /// How far the objects ended from their goals in the rehearsal, metres.
    rehearsed_m: Vec<f64>,
    n_steps: usize,
}

/// The pair as somebody who built a model of it would have it: no noise, no delay, other friction.
fn twin_of(simulated: &SimulatedConfig) -> SimulatedConfig {
    SimulatedConfig {
        latency_periods: [1, 1],
        angle_noise_rad: 0.0,
        rate_noise_radps: 0.0,
        torque_noise_nm: 0.0,
        camera: CameraConfig { place_noise_m: 0.0, turn_noise_rad: 0.0, ..simulated.camera },
        gripper: GripperConfig {
            pad_friction: TWIN_FRICTION * simulated.gripper.pad_friction,
            ..simulated.gripper
        },
        table_friction: TWIN_FRICTION * simulated.table_friction,
        ..simulated.clone()
    }
}
