//! The closed loop: a look, a decision and a motion at a time.

use glam::{DVec3, EulerRot};
use tandem_core::ArmIndex;
use tandem_core::layout::{EPISODE_STEPS, GOAL_TOLERANCE_M};
use tandem_kinematics::{ArmWayPoint, Cell, Joints, Posture, ReachError, WayPoint};

use crate::simulated::{MAX_OPENING_M, ObjectPose};
use crate::trial::Decide;
use crate::trial::judge::Cause;
use crate::trial::mapping::{ArmMoment, observe_arm};
use crate::trial::rollout::TrialStart;
use crate::trial::run::{Course, REST_S, Trials};
use crate::trial::shape::{Pads, SeenBlock, way};
use crate::trial::stage::{Stage, tools};

/// A policy is done when every object was this near to its goal, as a share of the tolerance, so many times in a row.
const DONE_SHARE: f64 = 0.6;
const DONE_LOOKS: usize = 5;
/// Displacements and openings below which a step is no motion, metres and shares.
const STILL_M: f64 = 5e-4;
const STILL_OPENING: f64 = 0.005;
/// Room between the arms that a step keeps where it can, metres: more than the check asks for, so that the next one
/// can begin.
pub(super) const STEP_GAP_M: f64 = 0.025;
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
    /// Where the tools went so far.
    way_points: Vec<WayPoint>,
}

impl Trials {
    /// A look, a decision and a motion at a time.
    pub(super) fn closed_loop(
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
            way_points: Vec::new(),
        };
        let mut hands = Hands {
            at: at.to_vec(),
            openings_m: vec![start.opening_m; at.len()],
            velocities: vec![DVec3::ZERO; at.len()],
            before: None,
            n_done: 0,
            way_points: Vec::new(),
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
                    break;
                }
            }
        }
        course.ended = course.ended.and_then(|()| stage.wait(REST_S));
        course.way_points = hands.way_points;
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
            let Ok([corner, end, last]) = self.ways(&from, &to, &openings_m, hands, blocks) else {
                continue;
            };
            if is_still(&first, &corner) && is_still(&first, &last) {
                hands.openings_m = openings_m;
                return Ok(attempt == 0);
            }
            let way_points = [first.clone(), corner, end, last];
            let makes_room = parts.iter().any(|part| matches!(part, Part::Back));
            let check = if makes_room { &self.check } else { &self.step_check };
            let Ok(motion) = self.motion(&way_points, &hands.at, check) else { continue };
            let ends: Vec<Joints> =
                motion.arms.iter().map(|samples| samples[samples.len() - 1].angles).collect();
            match stage.play(motion, self.config.speed) {
                Err(Cause::Refused(_)) => continue,
                played => played?,
            }
            hands.follow(way_points);
            (hands.at, hands.openings_m) = (ends, openings_m);
            return Ok(attempt == 0);
        }
        Ok(false)
    }

    /// Where the tools go on their way from end effectors `from` to `to` (own frames, metres): a corner, the end, and the
    /// end once more, where grippers close that are to close. One that closes on its way would drag what it holds along.
    fn ways(
        &self,
        from: &[DVec3],
        to: &[DVec3],
        openings_m: &[f64],
        hands: &Hands,
        blocks: &[SeenBlock],
    ) -> Result<[WayPoint; 3], ReachError> {
        let mut ways: [WayPoint; 3] = Default::default();
        for (arm, placed) in self.mapping.cell().arms.iter().enumerate() {
            let (idx, near) = (ArmIndex(arm), &hands.at[arm]);
            let [before, opening] = [hands.openings_m[arm], openings_m[arm]]
                .map(|opening_m| self.mapping.opening(opening_m));
            let [from, to] = [from, to].map(|own| self.mapping.pads_in_world(idx, own[arm]));
            let (_, then) = self.mapping.tool_for_pads(idx, to, near)?;
            let tilt_rad = |angles| Posture::of(placed.model, angles).tilt_rad();
            let pads = Pads {
                yaw_rad: placed.yaw_rad + Cell::FINGERS_YAW_RAD,
                opening_m: before * f64::from(MAX_OPENING_M),
                tilt_rad: tilt_rad(near).max(tilt_rad(&then)),
            };
            let [corner, end] = way(from, to, &pads, blocks);
            let openings = if opening < before {
                [before, before, opening]
            } else {
                [0.5 * (before + opening), opening, opening]
            };
            let points = [corner, end, end];
            for ((way, point), opening) in ways.iter_mut().zip(points).zip(openings) {
                let (tool_in_world_m, _) = self.mapping.tool_for_pads(idx, point, near)?;
                way.push(ArmWayPoint { tool_in_world_m, opening });
            }
        }
        Ok(ways)
    }
}

impl Hands {
    /// Adds a step's way points, of which the first is where the tools were.
    fn follow(&mut self, step: [WayPoint; 4]) {
        let known = usize::from(!self.way_points.is_empty());
        self.way_points.extend(step.into_iter().skip(known));
    }

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
