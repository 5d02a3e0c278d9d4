//! One trial from its start to its end.

use glam::{DVec3, EulerRot};
use tandem_core::ArmIndex;
use tandem_core::layout::{EPISODE_STEPS, GOAL_TOLERANCE_M};
use tandem_kinematics::{
    ArmWayPoint, Cell, CheckSettings, Joints, Motion, PlanSettings, Posture, ReachError, WayPoint,
    check, plan,
};
use tandem_sim::SimError;

use crate::layout::{check_settings, mico_cell};
use crate::simulated::{Block, MAX_OPENING_M, ObjectPose, SimulatedConfig, SimulatedPair};
use crate::trial::judge::{Cause, ObjectCourse, RefusedBy, judge};
use crate::trial::mapping::{ArmMoment, Mapping, observe_arm};
use crate::trial::rollout::{Rehearsal, Rollout, TrialStart};
use crate::trial::shape::{Pads, SeenBlock, way};
use crate::trial::stage::{Stage, tools};
use crate::trial::{Decide, Mode, TrialConfig, TrialError, TrialReport, Witness};

/// Samples of a motion per second.
const RATE_HZ: f64 = 100.0;
/// Time for objects to come to rest before they are judged, seconds.
const REST_S: f64 = 0.5;
/// A policy is done when every object was this near to its goal, as a share of the tolerance, so many times in a row.
const DONE_SHARE: f64 = 0.6;
const DONE_LOOKS: usize = 5;
/// Displacements and openings below which a step is no motion, metres and shares.
const STILL_M: f64 = 5e-4;
const STILL_OPENING: f64 = 0.005;
/// Room between the arms that a step keeps where it can, metres: more than the check asks for, so that the next one
/// can begin.
const STEP_GAP_M: f64 = 0.025;
/// Where an arm goes that has to make room, own frame, metres.
const BACK_M: DVec3 = DVec3::new(-0.03, 0.0, 0.015);

/// What an arm does of a step.
#[derive(Clone, Copy)]
enum Part {
    /// This share of what the policy asked for.
    Share(f64),
    /// It makes room for the other one.
    Back,
}

/// What is tried, one after the other, until the check allows it.
const ATTEMPTS: [[Part; 2]; 10] = {
    use Part::{Back, Share};
    [
        [Share(1.0), Share(1.0)],
        [Share(0.5), Share(0.5)],
        [Share(0.2), Share(0.2)],
        [Share(1.0), Share(0.0)],
        [Share(0.0), Share(1.0)],
        [Share(0.4), Share(0.0)],
        [Share(0.0), Share(0.4)],
        [Share(0.6), Back],
        [Back, Share(0.6)],
        [Back, Back],
    ]
};

/// Trials that differ in their numbers only.
pub struct Trials {
    config: TrialConfig,
    mapping: Mapping,
    rehearsal: Rehearsal,
    check: CheckSettings,
    /// For steps of the closed loop.
    step_check: CheckSettings,
}

/// How far a trial has come when it ends.
struct Course {
    ended: Result<(), Cause>,
    n_steps: usize,
    n_shortened: usize,
    rehearsed_m: Option<Vec<f64>>,
    time_over: bool,
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
        let rollout = match self.config.mode {
            Mode::OpenLoop => Some(self.rehearsal.play(policy)?),
            Mode::ClosedLoop => None,
        };
        let pair = self.pair(&start, &at, number);
        let lain: Vec<ObjectPose> = pair.objects();
        let goals = self.in_world(&start.goals);
        let mut stage = Stage::new(self.mapping.cell().clone(), pair, goals, witness)?;
        let course = match rollout {
            Some(rollout) => self.open_loop(&mut stage, &start, &at, &rollout),
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
        let judged = || judge(self.config.layout.task, &objects, stage.touched, course.time_over);
        let cause = course.ended.err().or_else(judged);
        TrialReport {
            number,
            cause,
            rehearsed_m: course.rehearsed_m,
            duration_s: stage.now_s(),
            n_steps: course.n_steps,
            n_shortened: course.n_shortened,
            touched: stage.touched,
            arms_gap_m: stage.arms_gap_m,
            table_gap_m: stage.table_gap_m,
            path: stage.path.clone(),
            objects,
        }
    }

    /// One motion of all of a rollout.
    fn open_loop(
        &self,
        stage: &mut Stage<'_>,
        start: &TrialStart,
        at: &[Joints],
        rollout: &Rollout,
    ) -> Course {
        let mut openings = vec![start.opening_m; start.hands.len()];
        let mut way_points = vec![self.way_point(&start.hands, &openings, at)];
        for step in &rollout.steps {
            for (arm, opening_m) in openings.iter_mut().enumerate() {
                let action = &step.action[self.config.layout.action_of(ArmIndex(arm))];
                *opening_m = self.mapping.opening_after(*opening_m, action);
            }
            way_points.push(self.way_point(&step.hands, &openings, at));
        }
        let ended = way_points
            .into_iter()
            .collect::<Result<Vec<WayPoint>, Cause>>()
            .and_then(|way_points| self.motion(&way_points, at, &self.check))
            .and_then(|motion| stage.play(motion, self.config.speed))
            .and_then(|()| stage.wait(REST_S));
        Course {
            ended,
            n_steps: rollout.steps.len(),
            n_shortened: 0,
            rehearsed_m: Some(rollout.goal_distances_m.clone()),
            time_over: false,
        }
    }

    /// A look, a decision and a motion at a time.
    fn closed_loop(
        &self,
        stage: &mut Stage<'_>,
        start: &TrialStart,
        at: &[Joints],
        policy: &mut dyn Decide,
    ) -> Course {
        let mut course = Course {
            ended: Ok(()),
            n_steps: 0,
            n_shortened: 0,
            rehearsed_m: None,
            time_over: false,
        };
        let mut hands = Hands {
            at: at.to_vec(),
            openings_m: vec![start.opening_m; at.len()],
            velocities: vec![DVec3::ZERO; at.len()],
            before: None,
            n_done: 0,
        };
        let time_limit_s = self.config.time_limit_s / self.config.speed;
        while course.n_steps < EPISODE_STEPS && hands.n_done < DONE_LOOKS {
            if stage.now_s() > time_limit_s {
                course.time_over = true;
                break;
            }
            course.n_steps += 1;
            match self.step(stage, start, &mut hands, policy) {
                Ok(whole) => course.n_shortened += usize::from(!whole),
                Err(cause) => {
                    course.ended = Err(cause);
                    return course;
                }
            }
        }
        course.ended = stage.wait(REST_S);
        course
    }

    /// One step of the closed loop; tells whether the arms did all of what the policy asked for.
    fn step(
        &self,
        stage: &mut Stage<'_>,
        start: &TrialStart,
        hands: &mut Hands,
        policy: &mut dyn Decide,
    ) -> Result<bool, Cause> {
        let layout = self.config.layout;
        let seen = stage.look()?;
        let now: Vec<ArmMoment> = stage
            .encoders()
            .iter()
            .zip(&seen)
            .enumerate()
            .map(|(arm, ((angles, opening), object))| {
                let velocity = hands.velocities[arm];
                self.mapping.moment(ArmIndex(arm), angles, *opening, velocity, object)
            })
            .collect();
        hands.count_done(&now, &start.goals);
        let before = hands.before.replace(now.clone()).unwrap_or_else(|| now.clone());
        let mut observation = vec![0.0; layout.n_observation()];
        let mut goal = vec![0.0; layout.n_goal()];
        for arm in layout.arms() {
            let numbers = &mut observation[layout.observation_of(arm)];
            observe_arm(&now[arm.0], &before[arm.0], numbers);
            goal[layout.goal_of(arm)].copy_from_slice(&start.goals[arm.0].as_vec3().to_array());
        }
        let mut action = vec![0.0; layout.n_action()];
        policy.decide(&observation, &goal, &mut action);
        let mut wanted: Vec<(DVec3, f64)> = Vec::new();
        for arm in layout.arms() {
            let action = &action[layout.action_of(arm)];
            let opening_m = self.mapping.opening_after(hands.openings_m[arm.0], action);
            let velocity = &mut hands.velocities[arm.0];
            let (hand, then) = self.mapping.hand_after(now[arm.0].hand, *velocity, action);
            *velocity = then;
            wanted.push((hand, opening_m));
        }
        let block = |object: &ObjectPose| SeenBlock {
            at: object.at_m,
            yaw_rad: object.turn.to_euler(EulerRot::ZYX).0,
            half_m: f64::from(self.config.block.half_m),
        };
        let blocks: Vec<SeenBlock> = seen.iter().map(block).collect();
        self.go(stage, hands, &wanted, &blocks)
    }

    /// Moves the hands to where they are `wanted`, or as far as the check allows.
    fn go(
        &self,
        stage: &mut Stage<'_>,
        hands: &mut Hands,
        wanted: &[(DVec3, f64)],
        blocks: &[SeenBlock],
    ) -> Result<bool, Cause> {
        let cell = self.mapping.cell();
        let from: Vec<DVec3> = (0..wanted.len())
            .map(|arm| self.mapping.hand_in_own(ArmIndex(arm), &hands.at[arm]))
            .collect();
        let openings = |openings_m: &[f64]| -> Vec<f64> {
            openings_m.iter().map(|opening_m| self.mapping.opening(*opening_m)).collect()
        };
        let here = tools(cell, &hands.at);
        let first: WayPoint = here
            .iter()
            .zip(openings(&hands.openings_m))
            .map(|(tool, opening)| ArmWayPoint { tool_in_world_m: *tool, opening })
            .collect();
        let openings_m: Vec<f64> = wanted.iter().map(|(_, opening_m)| *opening_m).collect();
        for (attempt, parts) in ATTEMPTS.iter().enumerate() {
            let to: Vec<DVec3> = (0..wanted.len())
                .map(|arm| match parts[arm] {
                    Part::Share(share) => from[arm].lerp(wanted[arm].0, share),
                    Part::Back => from[arm] + BACK_M,
                })
                .collect();
            let Ok([corner, last]) = self.ways(&from, &to, &openings_m, hands, blocks) else {
                continue;
            };
            if is_still(&first, &corner) && is_still(&first, &last) {
                hands.openings_m = openings_m;
                return Ok(attempt == 0);
            }
            let way_points = [first.clone(), corner, last];
            let makes_room = parts.iter().any(|part| matches!(part, Part::Back));
            let check = if makes_room { &self.check } else { &self.step_check };
            let Ok(motion) = self.motion(&way_points, &hands.at, check) else { continue };
            let ends: Vec<Joints> =
                motion.arms.iter().map(|samples| samples[samples.len() - 1].angles).collect();
            stage.play(motion, self.config.speed)?;
            (hands.at, hands.openings_m) = (ends, openings_m);
            return Ok(attempt == 0);
        }
        Ok(false)
    }

    /// Where the tools go on their way from end effectors `from` to `to` (own frames, metres): a corner and the end.
    fn ways(
        &self,
        from: &[DVec3],
        to: &[DVec3],
        openings_m: &[f64],
        hands: &Hands,
        blocks: &[SeenBlock],
    ) -> Result<[WayPoint; 2], ReachError> {
        let mut ways: [WayPoint; 2] = [Vec::new(), Vec::new()];
        for (arm, placed) in self.mapping.cell().arms.iter().enumerate() {
            let (idx, near) = (ArmIndex(arm), &hands.at[arm]);
            let [before, opening] = [hands.openings_m[arm], openings_m[arm]]
                .map(|opening_m| self.mapping.opening(opening_m));
            let [from, to] = [from, to].map(|own| self.mapping.pads_in_world(idx, own[arm]));
            let (_, then) = self.mapping.tool_for_pads(idx, to, near)?;
            let tilt_rad = |angles| Posture::of(placed.model, angles).tilt_rad();
            let pads = Pads {
                yaw_rad: placed.yaw_rad + Cell::FINGERS_YAW_RAD,
                opening_m: before.min(opening) * f64::from(MAX_OPENING_M),
                tilt_rad: tilt_rad(near).max(tilt_rad(&then)),
            };
            let points = way(from, to, &pads, blocks);
            let openings = [0.5 * (before + opening), opening];
            for ((way, point), opening) in ways.iter_mut().zip(points).zip(openings) {
                let (tool_in_world_m, _) = self.mapping.tool_for_pads(idx, point, near)?;
                way.push(ArmWayPoint { tool_in_world_m, opening });
            }
        }
        Ok(ways)
    }

    /// The motion through `way_points` from joint angles `at`, when it passes the check with `settings`.
    fn motion(
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
    fn way_point(
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

    fn pair(&self, start: &TrialStart, at: &[Joints], number: u64) -> SimulatedPair {
        let block = |at: DVec3| {
            let at = at.as_vec3();
            Block { at_m: [at.x, at.y], ..self.config.block }
        };
        let config = SimulatedConfig {
            seed: self.config.seed.wrapping_mul(1_000_003).wrapping_add(number),
            blocks: self.in_world(&start.objects).into_iter().map(block).collect(),
            ..self.config.simulated.clone()
        };
        let opening = self.mapping.opening(start.opening_m);
        SimulatedPair::new(self.mapping.cell().clone(), at, opening, config)
    }
}

/// What the closed loop remembers.
struct Hands {
    /// Joint angles where the arms were told to be, radians.
    at: Vec<Joints>,
    /// Openings that were told, metres on each side.
    openings_m: Vec<f64>,
    /// What the training world's hands would have, own frames, metres per second.
    velocities: Vec<DVec3>,
    before: Option<Vec<ArmMoment>>,
    /// Looks in a row at which every object was at its goal.
    n_done: usize,
}

impl Hands {
    fn count_done(&mut self, now: &[ArmMoment], goals: &[DVec3]) {
        let near_m = DONE_SHARE * f64::from(GOAL_TOLERANCE_M);
        let done = now.iter().zip(goals).all(|(now, goal)| (now.object - *goal).length() <= near_m);
        self.n_done = if done { self.n_done + 1 } else { 0 };
    }
}

fn is_still(from: &WayPoint, to: &WayPoint) -> bool {
    from.iter().zip(to).all(|(from, to)| {
        (from.tool_in_world_m - to.tool_in_world_m).length() < STILL_M
            && (from.opening - to.opening).abs() < STILL_OPENING
    })
}
