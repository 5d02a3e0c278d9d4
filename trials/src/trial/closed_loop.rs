//! The steps of the closed loop: each observes, asks the policy and moves the arms. [`episodes`] repeats them.

use glam::{DMat3, DVec3, EulerRot};
use rand_chacha::ChaCha8Rng;
use tandem_core::ArmIndex;
use tandem_core::scene::Cuboid;
use tandem_kinematics::{
    ArmWaypoint, CheckSettings, ForwardKinematics, Joints, PlacedArm, ReachError, Waypoint,
};

use self::progress::Progress;
use crate::simulated::{MAX_OPENING_M, ObjectPose, SharedObject};
use crate::trial::ActionSource;
use crate::trial::block_avoidance::{ObservedBlock, Pads, Way, avoid_blocks, lowered};
use crate::trial::mapping::ArmObservation;
use crate::trial::outcome::FailureCause;
use crate::trial::rehearsal::TrialStart;
use crate::trial::rig::{TrialRig, tool_positions};
use crate::trial::runner::{TrialRunner, unreachable};
use crate::trial::shared_object::keep_distance;

mod episodes;
mod grasping;
mod nudging;
mod order;
mod progress;
mod recalling;
mod sparing;
mod squeezing;
mod yielding;

/// Share of the tolerance of its goal within which an object counts as placed.
const DONE_SHARE: f64 = 0.9;
/// Displacements (metres) and changes of the opening (shares) below which a step needs no motion.
const STILL_M: f64 = 5e-4;
const STILL_OPENING: f64 = 0.005;
/// The displacement of an arm that makes room, own frame, metres.
const BACK_M: DVec3 = DVec3::new(-0.03, 0.0, 0.015);

/// The displacements of an arm that stays or withdraws from the other one, own frame, metres.
const APART_M: [DVec3; 5] = [
    DVec3::ZERO,
    DVec3::new(-0.04, 0.0, 0.02),
    DVec3::new(0.0, 0.0, 0.05),
    DVec3::new(0.0, -0.04, 0.03),
    DVec3::new(0.0, 0.04, 0.03),
];

/// The part of a step that an arm carries out.
#[derive(Clone, Copy)]
enum StepPart {
    /// This share of the policy's displacement.
    Share(f64),
    /// Makes room for the other arm.
    Back,
}

/// The attempts at a step, in order, until the check allows one. Arms that share an object move together or not at all, so
/// only the first three remain.
const ATTEMPTS: [[StepPart; 2]; 10] = {
    use StepPart::{Back, Share};
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

/// What the policy wants in a step, and what is in the way.
struct WantedStep<'a> {
    /// The end effectors after the step, own frames, metres.
    hands: Vec<DVec3>,
    /// The openings after the step, metres on each side.
    openings_m: Vec<f64>,
    blocks: &'a [ObservedBlock],
}

/// The state of the closed loop.
struct LoopState {
    /// The commanded joint angles, radians.
    at: Vec<Joints>,
    /// The commanded openings, metres on each side.
    openings_m: Vec<f64>,
    /// The velocities of the training world's hands, own frames, metres per second.
    velocities: Vec<DVec3>,
    before: Option<Vec<ArmObservation>>,
    /// The number of consecutive observations with every object at its goal.
    n_done: usize,
    /// The number of consecutive judgements, up to now, that found the task achieved.
    n_in_success: usize,
    /// Whether an arm holds an object that all arms share.
    carries: bool,
    progress: Progress,
    /// Whether each gripper opens only as wide as its object needs, because another object lies next to it.
    narrow: Vec<bool>,
    /// By how much each hand is to withdraw from what it presses on, own frames, metres.
    withdraw: Option<Vec<DVec3>>,
    /// The arms that stay out of the other arm's way: their objects are at their goals, or they wait for their turn.
    parked: Vec<bool>,
    /// The number of times that an arm has waited for its turn.
    n_waits: usize,
    /// The generator of the noise in the actions, after the first episode.
    noise: Option<ChaCha8Rng>,
    /// The waypoints of the tools so far.
    waypoints: Vec<Waypoint>,
}

impl TrialRunner {
    /// Carries out one step. Returns whether the arms carried out the policy's whole action.
    fn step(
        &self,
        rig: &mut TrialRig<'_>,
        start: &TrialStart,
        state: &mut LoopState,
        policy: &mut dyn ActionSource,
    ) -> Result<bool, FailureCause> {
        let layout = self.config.layout;
        let objects = rig.observe_objects()?;
        if state.before.is_some() {
            state.count_success(self.is_success(rig, start));
        }
        let now: Vec<ArmObservation> = rig
            .encoders()
            .iter()
            .zip(&objects)
            .enumerate()
            .map(|(arm, ((angles, opening), object))| {
                let velocity = state.velocities[arm];
                self.mapping.observe(ArmIndex(arm), angles, *opening, velocity, object)
            })
            .collect();
        let seen = self.held_as_in_training(&now, state);
        let before = state.before.replace(seen.clone()).unwrap_or_else(|| seen.clone());
        let mut observation = vec![0.0; layout.n_observation()];
        let mut goal = vec![0.0; layout.n_goal()];
        for arm in layout.arms() {
            let numbers = &mut observation[layout.observation_of(arm)];
            self.mapping.write_observation(&seen[arm.0], &before[arm.0], numbers);
            goal[layout.goal_of(arm)].copy_from_slice(&start.goals[arm.0].as_vec3().to_array());
        }
        let meets = layout.arms().all(|arm| self.task.arm_meets_conditions(arm, &observation));
        let at: Vec<DVec3> = now.iter().map(|now| now.object).collect();
        let misplaced: Vec<bool> = self.misplaced(&objects, start).collect();
        state.progress.see(&at, &misplaced);
        state.count_done(&now, &start.goals, self.tolerance_m(), meets);
        state.carries = self.task.shares_object()
            && layout.arms().any(|arm| self.task.arm_holds(arm, &observation));
        let blocks = self.observed_blocks(&objects, start.shared.as_ref());
        if self.withdraw(rig, state, &blocks)? {
            return Ok(false);
        }
        let mut action = vec![0.0; layout.n_action()];
        policy.act(&observation, &goal, &mut action);
        state.explore(&mut action);
        let mut wanted = WantedStep { hands: Vec::new(), openings_m: Vec::new(), blocks: &blocks };
        for arm in layout.arms() {
            let action = &action[layout.action_of(arm)];
            let commanded_m = state.openings_m[arm.0];
            let opening_m = self.mapping.opening_after(commanded_m, now[arm.0].opening_m, action);
            let velocity = &mut state.velocities[arm.0];
            let (hand, then) = self.mapping.hand_after(now[arm.0].hand, *velocity, action);
            *velocity = then;
            wanted.hands.push(hand);
            wanted.openings_m.push(opening_m);
        }
        self.spare_objects(state, &now, &start.goals, &mut wanted);
        self.keep_parked(state, &mut wanted);
        self.move_hands(rig, state, &wanted)
    }

    /// Returns the blocks at the observed poses; of a shared object, its parts by the poses of the arms' points.
    fn observed_blocks(
        &self,
        objects: &[ObjectPose],
        shared: Option<&SharedObject>,
    ) -> Vec<ObservedBlock> {
        let yaw_rad = |object: &ObjectPose| object.turn.to_euler(EulerRot::ZYX).0;
        let Some(shared) = shared else {
            let half_m = DVec3::splat(self.config.block.half_m.into());
            let block = |object: &ObjectPose| ObservedBlock {
                at: object.at_m,
                yaw_rad: yaw_rad(object),
                half_m,
            };
            return objects.iter().map(block).collect();
        };
        let double = |numbers: [f32; 3]| DVec3::from_array(numbers.map(f64::from));
        // Each part is nearest to the point of one arm, whose observed pose places it best.
        let block = |part: &Cuboid| {
            let offset = |arm: usize| double(part.centre) - double(shared.points_m[arm]);
            let nearer = |a: &usize, b: &usize| {
                offset(*a).length_squared().total_cmp(&offset(*b).length_squared())
            };
            let arm = (0..objects.len()).min_by(nearer).unwrap_or(0);
            let object = &objects[arm];
            ObservedBlock {
                at: object.at_m + object.turn * offset(arm),
                yaw_rad: yaw_rad(object),
                half_m: double(part.half_extents_m),
            }
        };
        shared.shown.iter().map(block).collect()
    }

    /// Moves the hands to the wanted positions, or as far as the check allows. Returns whether they arrived.
    fn move_hands(
        &self,
        rig: &mut TrialRig<'_>,
        state: &mut LoopState,
        wanted: &WantedStep<'_>,
    ) -> Result<bool, FailureCause> {
        let from = self.hands(state);
        for (attempt, parts) in ATTEMPTS.iter().enumerate() {
            if state.carries && !is_joint(parts) {
                continue;
            }
            let mut to: Vec<DVec3> = (0..from.len())
                .map(|arm| match parts[arm] {
                    StepPart::Share(share) => from[arm].lerp(wanted.hands[arm], share),
                    StepPart::Back => from[arm] + BACK_M,
                })
                .collect();
            if state.carries {
                self.keep_hands_apart(&from, &mut to);
            }
            let makes_room = parts.iter().any(|part| matches!(part, StepPart::Back));
            let check = if makes_room { &self.check } else { &self.step_check };
            if self.attempt(rig, state, wanted, &to, check)? {
                let is_whole = attempt == 0 && state.withdraw.is_none();
                return Ok(is_whole && !state.progress.is_held_up());
            }
        }
        if !state.carries {
            for to in self.ways_apart(&from, state) {
                if self.attempt(rig, state, wanted, &to, &self.check)? {
                    break;
                }
            }
        }
        Ok(false)
    }

    /// Moves the hands `to` (own frames, metres) if `check` allows it. Returns whether it does, also if the hands are there.
    fn attempt(
        &self,
        rig: &mut TrialRig<'_>,
        state: &mut LoopState,
        wanted: &WantedStep<'_>,
        to: &[DVec3],
        check: &CheckSettings,
    ) -> Result<bool, FailureCause> {
        let first = self.tools(state);
        let measured = rig.encoders().into_iter().map(|(_, opening)| opening);
        let Ok((step, held_up)) = self.step_waypoints(to, state, wanted, measured) else {
            return Ok(false);
        };
        state.progress.hold_up(held_up);
        if step.iter().all(|waypoint| is_still(&first, waypoint)) {
            state.openings_m.clone_from(&wanted.openings_m);
            return Ok(true);
        }
        let [rise, corner, end, last] = step;
        let waypoints = [first.clone(), rise, corner, end, last];
        let Ok(motion) = self.motion(&waypoints, &state.at, check) else { return Ok(false) };
        let ends: Vec<Joints> =
            motion.arms.iter().map(|samples| samples[samples.len() - 1].angles).collect();
        let played = if state.carries {
            rig.play(motion, self.config.speed).map(|()| true)
        } else {
            rig.play_yielding(motion, self.config.speed * self.step_speed(state, wanted, to))
        };
        let is_whole = match played {
            Err(FailureCause::Refused(_)) => return Ok(false),
            played => played?,
        };
        if is_whole {
            state.at = ends;
            state.openings_m.clone_from(&wanted.openings_m);
            state.append_waypoints(waypoints);
        } else {
            self.yielded(rig, state, first);
        }
        Ok(true)
    }

    /// Returns the tools at the commanded angles, with the commanded openings.
    fn tools(&self, state: &LoopState) -> Waypoint {
        let openings = state.openings_m.iter().map(|opening_m| self.mapping.opening(*opening_m));
        tool_positions(self.mapping.cell(), &state.at)
            .iter()
            .zip(openings)
            .map(|(tool, opening)| ArmWaypoint {
                tool_in_world_m: (*tool).into(),
                gripper_opening: opening,
            })
            .collect()
    }

    /// The end effectors at the commanded angles, own frames, metres.
    fn hands(&self, state: &LoopState) -> Vec<DVec3> {
        let arms = state.at.iter().enumerate();
        arms.map(|(arm, at)| self.mapping.hand_in_own(ArmIndex(arm), at)).collect()
    }

    /// Returns the positions of the hands (own frames, metres) in which two arms are farther apart than `from`, farthest
    /// first.
    fn ways_apart(&self, from: &[DVec3], state: &LoopState) -> Vec<Vec<DVec3>> {
        let gap_m = |hands: &[DVec3]| {
            let reached = hands.iter().zip(&state.at).enumerate().map(|(arm, (hand, near))| {
                self.mapping.tool_in_world(ArmIndex(arm), *hand, near).map(|(_, angles)| angles)
            });
            let angles: Result<Vec<Joints>, ReachError> = reached.collect();
            angles.map_or(f64::NEG_INFINITY, |angles| self.mapping.cell().gaps(&angles).arms_m)
        };
        let [first, second] = from else { return Vec::new() };
        let now_m = gap_m(from);
        let mut ways: Vec<(f64, Vec<DVec3>)> = Vec::new();
        for one in APART_M {
            for other in APART_M {
                let to = vec![*first + one, *second + other];
                let to_m = gap_m(&to);
                if to_m > now_m {
                    ways.push((to_m, to));
                }
            }
        }
        ways.sort_by(|(one_m, _), (other_m, _)| other_m.total_cmp(one_m));
        ways.into_iter().map(|(_, to)| to).collect()
    }

    /// Returns the points between the pads of end effectors at `hands` (own frames, metres), world frame, metres.
    fn pads_of(&self, hands: &[DVec3]) -> Vec<DVec3> {
        let hands = hands.iter().enumerate();
        hands.map(|(arm, own)| self.mapping.pads_in_world(ArmIndex(arm), *own)).collect()
    }

    /// Moves the end effectors `to` so that they are as far apart as `from`; own frames, metres.
    fn keep_hands_apart(&self, from: &[DVec3], to: &mut [DVec3]) {
        let mut pads = self.pads_of(to);
        keep_distance(&self.pads_of(from), &mut pads);
        for (arm, (to, pads)) in to.iter_mut().zip(pads).enumerate() {
            *to = self.mapping.hand_of_pads(ArmIndex(arm), pads);
        }
    }

    /// Returns the waypoints of the tools for end effectors that move `to` (own frames, metres): two corners, the end, and
    /// the end again with closed grippers. A gripper that closed while it moves would drag its object along. `measured`
    /// are the openings of the grippers, 0 to 1. Also returns whether a block keeps each hand from where it is to be.
    fn step_waypoints(
        &self,
        to: &[DVec3],
        state: &LoopState,
        wanted: &WantedStep<'_>,
        measured: impl Iterator<Item = f64>,
    ) -> Result<([Waypoint; 4], Vec<bool>), FailureCause> {
        let WantedStep { openings_m, blocks, .. } = wanted;
        let from = self.hands(state);
        let mut step: [Waypoint; 4] = Default::default();
        let mut held_up = Vec::new();
        let arms = self.mapping.cell().arms.iter().zip(measured).enumerate();
        for (arm, (placed, measured)) in arms {
            let (idx, near) = (ArmIndex(arm), &state.at[arm]);
            let [before, opening] = [state.openings_m[arm], openings_m[arm]]
                .map(|opening_m| self.mapping.opening(opening_m));
            let [from, to] = [from[arm], to[arm]].map(|own| self.mapping.pads_in_world(idx, own));
            let tool = |pads| {
                let tool = self.mapping.tool_for_pads(idx, pads, near);
                tool.map_err(|source| unreachable(idx, source))
            };
            let (_, then) = tool(to)?;
            let pads = |centre, angles| Pads {
                centre,
                axes: tool_axes(placed, angles),
                opening_m: before.max(opening).max(measured) * f64::from(MAX_OPENING_M),
                commanded_m: before * f64::from(MAX_OPENING_M),
            };
            let pads_before = pads(from, near);
            let way = if state.carries {
                let end = lowered(&pads_before, to, blocks);
                Way { points: [from, from.midpoint(end), end], is_held_up: false }
            } else {
                avoid_blocks(&pads_before, &pads(to, &then), blocks)
            };
            held_up.push(way.is_held_up);
            let openings = if opening < before {
                [before, before, before, opening]
            } else {
                [before, 0.5 * (before + opening), opening, opening]
            };
            let [rise, corner, end] = way.points;
            for ((waypoint, point), opening) in
                step.iter_mut().zip([rise, corner, end, end]).zip(openings)
            {
                let (tool_in_world_m, _) = tool(point)?;
                waypoint.push(ArmWaypoint {
                    tool_in_world_m: tool_in_world_m.into(),
                    gripper_opening: opening,
                });
            }
        }
        Ok((step, held_up))
    }
}

impl LoopState {
    /// The state at the start of a trial, at joint angles `at`, radians.
    fn new(start: &TrialStart, at: &[Joints]) -> Self {
        Self {
            at: at.to_vec(),
            openings_m: vec![start.opening_m; at.len()],
            velocities: vec![DVec3::ZERO; at.len()],
            before: None,
            n_done: 0,
            n_in_success: 0,
            carries: false,
            progress: Progress::new(at.len()),
            narrow: vec![false; at.len()],
            withdraw: None,
            parked: vec![false; at.len()],
            n_waits: 0,
            noise: None,
            waypoints: Vec::new(),
        }
    }

    /// Appends a step's waypoints. The first one is the previous position of the tools.
    fn append_waypoints(&mut self, step: [Waypoint; 5]) {
        let n_known = usize::from(!self.waypoints.is_empty());
        self.waypoints.extend(step.into_iter().skip(n_known));
    }

    fn count_success(&mut self, is_success: bool) {
        self.n_in_success = if is_success { self.n_in_success + 1 } else { 0 };
    }

    /// Counts an observation in which all arms met the task's conditions or not, as `meets` says.
    fn count_done(
        &mut self,
        now: &[ArmObservation],
        goals: &[DVec3],
        tolerance_m: f64,
        meets: bool,
    ) {
        let near_m = DONE_SHARE * tolerance_m;
        let done = meets
            && now.iter().zip(goals).all(|(now, goal)| (now.object - *goal).length() <= near_m);
        self.n_done = if done { self.n_done + 1 } else { 0 };
    }
}

/// Returns whether all arms carry out the same share of their displacements, so that they can carry an object together.
fn is_joint(parts: &[StepPart]) -> bool {
    let share = |part: &StepPart| match part {
        StepPart::Share(share) => Some(*share),
        StepPart::Back => None,
    };
    let first = parts.first().and_then(share);
    first.is_some() && parts.iter().all(|part| share(part) == first)
}

/// Returns the axes of an arm's tool as columns, world frame: its fingers close along the first and point along the third.
fn tool_axes(placed: &PlacedArm, angles: &Joints) -> DMat3 {
    let tool = placed.world_from_base() * ForwardKinematics::new(placed.model, angles).tool();
    DMat3::from_quat(tool.rotation.into())
}

fn is_still(from: &Waypoint, to: &Waypoint) -> bool {
    from.iter().zip(to).all(|(from, to)| {
        (from.tool_in_world_m - to.tool_in_world_m).norm() < STILL_M
            && (from.gripper_opening - to.gripper_opening).abs() < STILL_OPENING
    })
}
