//! The motion of one step: as much of it as the check allows, around the blocks.

use glam::{DMat3, DVec3};
use tandem_core::ArmIndex;
use tandem_kinematics::{
    ArmWaypoint, CheckSettings, ForwardKinematics, Joints, PlacedArm, ReachError, Waypoint,
};

use super::{ClosedLoop, LoopState, WantedStep};
use crate::simulated::MAX_OPENING_M;
use crate::trial::block_avoidance::{Pads, StepPath, avoid_blocks, lowered};
use crate::trial::outcome::FailureCause;
use crate::trial::rig::tool_positions;
use crate::trial::runner::{TrialRunner, unreachable};
use crate::trial::shared_object::keep_distance;

/// Displacements (metres) and changes of the opening (shares) below which a step needs no motion.
const STILL_DISTANCE_M: f64 = 5e-4;
const STILL_OPENING_CHANGE: f64 = 0.005;
/// The displacement of an arm that makes room, arm frame, metres.
const RETREAT_OFFSET_M: DVec3 = DVec3::new(-0.03, 0.0, 0.015);

/// The displacements of an arm that stays or withdraws from the other one, arm frame, metres.
const SEPARATING_OFFSETS_M: [DVec3; 5] = [
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
    Retreat,
}

/// The attempts at a step, in order, until the check allows one. While an arm holds an object that all share, the arms
/// move together or not at all, so only the first three remain.
const ATTEMPTS: [[StepPart; 2]; 10] = {
    use StepPart::{Retreat, Share};
    [
        [Share(1.0), Share(1.0)],
        [Share(0.5), Share(0.5)],
        [Share(0.2), Share(0.2)],
        [Share(1.0), Share(0.0)],
        [Share(0.0), Share(1.0)],
        [Share(0.4), Share(0.0)],
        [Share(0.0), Share(0.4)],
        [Share(0.6), Retreat],
        [Retreat, Share(0.6)],
        [Retreat, Retreat],
    ]
};

impl ClosedLoop<'_, '_> {
    /// Moves the hands to the wanted positions, or as far as the check allows. Returns whether they arrived.
    pub(super) fn move_hands(&mut self, wanted: &WantedStep<'_>) -> Result<bool, FailureCause> {
        let runner = self.runner;
        let from = runner.hands(&self.state);
        for (attempt, parts) in ATTEMPTS.iter().enumerate() {
            if self.state.carries() && !is_joint(parts) {
                continue;
            }
            let mut to: Vec<DVec3> = (0..from.len())
                .map(|arm| match parts[arm] {
                    StepPart::Share(share) => from[arm].lerp(wanted.hands[arm], share),
                    StepPart::Retreat => from[arm] + RETREAT_OFFSET_M,
                })
                .collect();
            if self.state.all_hold() {
                runner.keep_hands_apart(&from, &mut to);
            }
            let makes_room = parts.iter().any(|part| matches!(part, StepPart::Retreat));
            let check = if makes_room { &runner.check } else { &runner.step_check };
            if self.attempt(wanted, &to, check)? {
                let is_whole = attempt == 0 && self.state.withdraw.is_none();
                return Ok(is_whole && !self.state.progress.is_held_up());
            }
        }
        if !self.state.carries() {
            for to in runner.positions_apart(&from, &self.state) {
                if self.attempt(wanted, &to, &runner.check)? {
                    break;
                }
            }
        }
        Ok(false)
    }

    /// Moves the hands `to` (arm frames, metres) if `check` allows it. Returns whether it does, also if the hands are
    /// there.
    pub(super) fn attempt(
        &mut self,
        wanted: &WantedStep<'_>,
        to: &[DVec3],
        check: &CheckSettings,
    ) -> Result<bool, FailureCause> {
        let (runner, state) = (self.runner, &mut self.state);
        let first = runner.tools(state);
        let measured = self.rig.encoders().into_iter().map(|(_, opening)| opening);
        let Ok((step, held_up)) = runner.step_waypoints(to, state, wanted, measured) else {
            return Ok(false);
        };
        state.progress.hold_up(held_up);
        if step.iter().all(|waypoint| is_still(&first, waypoint)) {
            state.openings_m.clone_from(&wanted.openings_m);
            return Ok(true);
        }
        let [rise, corner, end, last] = step;
        let waypoints = [first.clone(), rise, corner, end, last];
        let Ok(motion) = runner.motion(&waypoints, &state.joint_angles, check) else {
            return Ok(false);
        };
        let ends: Vec<Joints> =
            motion.arms.iter().map(|samples| samples[samples.len() - 1].angles).collect();
        // What a hand that holds the object feels may come from the other one. A free hand that meets the object
        // yields.
        let yields: Vec<bool> = state.holds.iter().map(|holds| !holds).collect();
        let speed = runner.config.speed * runner.step_speed(state, wanted, to);
        let played = self.rig.play_yielding(motion, speed, &yields);
        let is_whole = match played {
            Err(FailureCause::Refused(_)) => return Ok(false),
            played => played?,
        };
        if is_whole {
            state.joint_angles = ends;
            state.openings_m.clone_from(&wanted.openings_m);
            state.append_waypoints(waypoints);
        } else {
            self.yielded(first);
        }
        Ok(true)
    }
}

impl TrialRunner {
    /// Returns the tools at the commanded angles, with the commanded openings.
    pub(super) fn tools(&self, state: &LoopState) -> Waypoint {
        let openings = state.openings_m.iter().map(|opening_m| self.mapping.opening(*opening_m));
        tool_positions(self.mapping.cell(), &state.joint_angles)
            .iter()
            .zip(openings)
            .map(|(tool, opening)| ArmWaypoint {
                tool_in_world_m: (*tool).into(),
                gripper_opening: opening,
            })
            .collect()
    }

    /// The end effectors at the commanded angles, arm frames, metres.
    pub(super) fn hands(&self, state: &LoopState) -> Vec<DVec3> {
        let arms = state.joint_angles.iter().enumerate();
        arms.map(|(arm, angles)| self.mapping.hand_in_arm(ArmIndex(arm), angles)).collect()
    }

    /// Returns the positions of the hands (arm frames, metres) in which two arms are farther apart than `from`,
    /// farthest first.
    fn positions_apart(&self, from: &[DVec3], state: &LoopState) -> Vec<Vec<DVec3>> {
        let gap_m = |hands: &[DVec3]| {
            let reached =
                hands.iter().zip(&state.joint_angles).enumerate().map(|(arm, (hand, near))| {
                    self.mapping.tool_in_world(ArmIndex(arm), *hand, near).map(|(_, angles)| angles)
                });
            let angles: Result<Vec<Joints>, ReachError> = reached.collect();
            angles.map_or(f64::NEG_INFINITY, |angles| self.mapping.cell().gaps(&angles).arms_m)
        };
        let [first, second] = from else { return Vec::new() };
        let now_m = gap_m(from);
        let mut candidates: Vec<(f64, Vec<DVec3>)> = Vec::new();
        for one in SEPARATING_OFFSETS_M {
            for other in SEPARATING_OFFSETS_M {
                let to = vec![*first + one, *second + other];
                let to_m = gap_m(&to);
                if to_m > now_m {
                    candidates.push((to_m, to));
                }
            }
        }
        candidates.sort_by(|(one_m, _), (other_m, _)| other_m.total_cmp(one_m));
        candidates.into_iter().map(|(_, to)| to).collect()
    }

    /// Returns the points between the pads of end effectors at `hands` (arm frames, metres), world frame, metres.
    pub(super) fn pads_of(&self, hands: &[DVec3]) -> Vec<DVec3> {
        let hands = hands.iter().enumerate();
        hands.map(|(arm, in_arm)| self.mapping.pads_in_world(ArmIndex(arm), *in_arm)).collect()
    }

    /// Moves the end effectors `to` so that they are as far apart as `from`; arm frames, metres.
    fn keep_hands_apart(&self, from: &[DVec3], to: &mut [DVec3]) {
        let mut pads = self.pads_of(to);
        keep_distance(&self.pads_of(from), &mut pads);
        for (arm, (to, pads)) in to.iter_mut().zip(pads).enumerate() {
            *to = self.mapping.hand_of_pads(ArmIndex(arm), pads);
        }
    }

    /// Returns the waypoints of the tools for end effectors that move `to` (arm frames, metres): two corners, the end,
    /// and the end again with closed grippers. A gripper that closed while it moves would drag its object along.
    /// `measured` are the openings of the grippers, 0 to 1. Also returns whether a block keeps each hand from where it
    /// is to be.
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
            let (idx, near) = (ArmIndex(arm), &state.joint_angles[arm]);
            let [before, opening] = [state.openings_m[arm], openings_m[arm]]
                .map(|opening_m| self.mapping.opening(opening_m));
            let [from, to] =
                [from[arm], to[arm]].map(|in_arm| self.mapping.pads_in_world(idx, in_arm));
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
            let path = if state.holds[arm] {
                let end = lowered(&pads_before, to, blocks);
                StepPath { points: [from, from.midpoint(end), end], is_held_up: false }
            } else {
                avoid_blocks(&pads_before, &pads(to, &then), blocks)
            };
            held_up.push(path.is_held_up);
            let openings = if opening < before {
                [before, before, before, opening]
            } else {
                [before, 0.5 * (before + opening), opening, opening]
            };
            let [rise, corner, end] = path.points;
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

/// Returns whether all arms carry out the same share of their displacements, so that they can carry an object together.
fn is_joint(parts: &[StepPart]) -> bool {
    let share = |part: &StepPart| match part {
        StepPart::Share(share) => Some(*share),
        StepPart::Retreat => None,
    };
    let first = parts.first().and_then(share);
    first.is_some() && parts.iter().all(|part| share(part) == first)
}

/// Returns the axes of an arm's tool as columns, world frame: its fingers close along the first and point along the
/// third.
pub(super) fn tool_axes(placed: &PlacedArm, angles: &Joints) -> DMat3 {
    let tool = placed.world_from_base() * ForwardKinematics::new(placed.model, angles).tool();
    DMat3::from_quat(tool.rotation.into())
}

fn is_still(from: &Waypoint, to: &Waypoint) -> bool {
    from.iter().zip(to).all(|(from, to)| {
        (from.tool_in_world_m - to.tool_in_world_m).norm() < STILL_DISTANCE_M
            && (from.gripper_opening - to.gripper_opening).abs() < STILL_OPENING_CHANGE
    })
}

#[cfg(test)]
mod tests {
    use tandem_core::Task;

    use super::*;
    use crate::trial::block_avoidance::ObservedBlock;
    use crate::trial::rig::{Goals, TrialRig};
    use crate::trial::runner::start_angles;
    use crate::trial::{NoObserver, TrialMode, test_config};

    fn runner() -> TrialRunner {
        TrialRunner::new(test_config(Task::CarryBar, TrialMode::ClosedLoop, 1)).unwrap()
    }

    #[test]
    fn hands_keep_their_distance_once_both_hold_the_object() {
        let mut runner = runner();
        let start = runner.start(0).unwrap();
        let joint_angles = start_angles(&runner.mapping, &start).unwrap();
        // The distance that the first hand moves and the change of the distance between the hands, metres, in a step in
        // which the second hand is to move by 2 cm.
        let step = |holds: [bool; 2]| {
            let pair = runner.pair(&start, &joint_angles, 0, &runner.config.simulated);
            let (cell, mut observer) = (runner.mapping.cell().clone(), NoObserver);
            let mut rig = TrialRig::new(cell, pair, Goals::default(), &mut observer).unwrap();
            let mut idle = |_: &[f32], _: &[f32], action: &mut [f32]| action.fill(0.0);
            let mut closed_loop =
                ClosedLoop::new(&runner, &mut rig, &start, &joint_angles, &mut idle);
            closed_loop.state.holds = holds.to_vec();
            let from = runner.hands(&closed_loop.state);
            let inward = DVec3::X * (-0.02 * from[1].x.signum());
            let openings_m = closed_loop.state.openings_m.clone();
            let wanted =
                WantedStep { hands: vec![from[0], from[1] + inward], openings_m, blocks: &[] };
            assert!(closed_loop.move_hands(&wanted).unwrap(), "{holds:?}");
            let to = runner.hands(&closed_loop.state);
            let [before_m, after_m] = [&from, &to].map(|hands| {
                let pads = runner.pads_of(hands);
                pads[0].distance(pads[1])
            });
            [from[0].distance(to[0]), (after_m - before_m).abs()]
        };
        let [moved_m, change_m] = step([true, false]);
        assert!(moved_m < 1e-3 && change_m > 0.01, "{moved_m} m, {change_m} m");
        let [moved_m, change_m] = step([true; 2]);
        assert!(moved_m > 5e-3 && change_m < 1e-3, "{moved_m} m, {change_m} m");
    }

    #[test]
    fn a_free_hand_does_not_descend_onto_the_object_that_the_other_one_holds() {
        let mut runner = runner();
        let start = runner.start(0).unwrap();
        let joint_angles = runner.mapping.cell().ready(0.2).unwrap();
        let mut state = LoopState::new(&start, &joint_angles);
        state.openings_m = vec![0.0; 2];
        let hands = runner.hands(&state);
        let half_m = DVec3::splat(0.03);
        let below =
            |pads: &DVec3| ObservedBlock { position: pads.with_z(half_m.z), yaw_rad: 0.0, half_m };
        let blocks: Vec<ObservedBlock> = runner.pads_of(&hands).iter().map(below).collect();
        let to: Vec<DVec3> = hands.iter().map(|hand| hand.with_z(0.05)).collect();
        let wanted = WantedStep { hands: to.clone(), openings_m: vec![0.0; 2], blocks: &blocks };
        let mut held_up = |holds: [bool; 2]| {
            state.holds = holds.to_vec();
            runner.step_waypoints(&to, &state, &wanted, [0.0; 2].into_iter()).unwrap().1
        };
        assert_eq!(held_up([true, false]), [false, true]);
        assert_eq!(held_up([false, false]), [true, true]);
    }
}
