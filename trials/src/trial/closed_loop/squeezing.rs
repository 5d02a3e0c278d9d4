//! Steps in which the hands of two arms press on blocks between them.
//!
//! In the training world the servos of both hands have a limited force, so the hands and the blocks stand still. Arms
//! would squeeze the blocks within a few hundredths of a second, too fast to yield. Such steps are therefore slow.

use glam::DVec3;

use super::{LoopState, WantedStep};
use crate::trial::block_avoidance::{ObservedBlock, direction};
use crate::trial::runner::TrialRunner;

/// The length of the line from hand to hand outside the blocks below which a step is slow, metres. The pads take 1 to
/// 2 cm of it.
const SQUEEZING_ROOM_M: f64 = 0.06;
/// The speed of a slow step, as a share of the trial's.
const SLOW_SHARE: f64 = 0.25;

impl TrialRunner {
    /// Returns the speed of a step that moves the hands `to` (arm frames, metres), as a share of the trial's. What arms
    /// share is between their hands all the time, and they do not press on it.
    pub(super) fn step_speed(
        &self,
        state: &LoopState,
        wanted: &WantedStep<'_>,
        to: &[DVec3],
    ) -> f64 {
        if self.task.shares_object() {
            return 1.0;
        }
        let squeezes = |hands: &[DVec3]| match self.pads_of(hands)[..] {
            [one, other] => {
                room_m(one, other, wanted.blocks).is_some_and(|room_m| room_m < SQUEEZING_ROOM_M)
            }
            _ => false,
        };
        if squeezes(&self.hands(state)) || squeezes(to) { SLOW_SHARE } else { 1.0 }
    }
}

/// Returns the length of the line between two points that is outside of `blocks`, metres; `None` if no block is between
/// them.
fn room_m(one: DVec3, other: DVec3, blocks: &[ObservedBlock]) -> Option<f64> {
    let inside: f64 = blocks.iter().map(|block| share_within(one, other, block)).sum();
    (inside > 0.0).then(|| (1.0 - inside) * one.distance(other))
}

/// Returns the share of the line between two points that is within `block`.
fn share_within(one: DVec3, other: DVec3, block: &ObservedBlock) -> f64 {
    let local = |point: DVec3| {
        let offset = point - block.position;
        direction(-block.yaw_rad).rotate(offset.truncate()).extend(offset.z).to_array()
    };
    let (from, to, half) = (local(one), local(other), block.half_m.to_array());
    let (mut enters, mut leaves) = (0.0_f64, 1.0_f64);
    for axis in 0..3 {
        // A line along a side crosses it at infinity, which leaves the whole line or nothing.
        let displacement = to[axis] - from[axis];
        let crossing = [-half[axis], half[axis]].map(|side| (side - from[axis]) / displacement);
        enters = enters.max(crossing[0].min(crossing[1]));
        leaves = leaves.min(crossing[0].max(crossing[1]));
    }
    (leaves - enters).max(0.0)
}

#[cfg(test)]
mod tests {
    use std::f64::consts::{FRAC_PI_4, SQRT_2};

    use super::*;

    const BLOCK: ObservedBlock = ObservedBlock {
        position: DVec3::new(0.1, 0.0, 0.03),
        yaw_rad: 0.0,
        half_m: DVec3::splat(0.03),
    };

    #[test]
    fn room_is_what_the_blocks_leave_of_the_line_from_hand_to_hand() {
        let hand = |x, z| DVec3::new(x, 0.0, z);
        let room = |one, other, blocks: &[ObservedBlock]| room_m(one, other, blocks);
        let near = |got: Option<f64>, wanted: f64| {
            assert!(got.is_some_and(|got| (got - wanted).abs() < 1e-12), "{got:?}, not {wanted}");
        };
        near(room(hand(0.0, 0.03), hand(0.2, 0.03), &[BLOCK]), 0.14);
        let second = ObservedBlock { position: hand(0.165, 0.03), ..BLOCK };
        near(room(hand(0.05, 0.03), hand(0.21, 0.03), &[BLOCK, second]), 0.04);
        let turned = ObservedBlock { yaw_rad: FRAC_PI_4, ..BLOCK };
        near(room(hand(0.0, 0.03), hand(0.2, 0.03), &[turned]), 0.2 - 0.06 * SQRT_2);
        near(room(hand(0.1, 0.03), hand(0.2, 0.03), &[BLOCK]), 0.07);
        assert_eq!(room(hand(0.0, 0.07), hand(0.2, 0.07), &[BLOCK]), None, "above the block");
        assert_eq!(room(hand(0.0, 0.03), hand(0.05, 0.03), &[BLOCK]), None, "on one side");
        let aside = DVec3::Y * 0.031;
        assert_eq!(room(hand(0.0, 0.03) + aside, hand(0.2, 0.03) + aside, &[BLOCK]), None);
    }
}
