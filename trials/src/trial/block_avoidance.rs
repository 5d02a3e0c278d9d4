//! The path of one step around the blocks: sideways before down, and down only where there is room.
//!
//! In the training world a hand that descends on a block rests on it and slides along. An arm would press until the
//! envelope stops it. A hand above a block's top therefore moves sideways first, and stays just above a block that its
//! pads would touch. A hand beside a block moves down first and then sideways, because pads that descend along a
//! block's side press it onto the table. A hand that holds a block lowers it to the table and no further.

use glam::{DVec2, DVec3};

/// Half a pad's width across the closing direction and half its thickness, metres; a little more than the real ones.
const PAD_HALF_M: DVec2 = DVec2::new(0.008, 0.005);
/// The pads' lower ends below the point between them, metres.
const PADS_BELOW_M: f64 = 0.015;
/// Distances that are kept beside and above a block, metres.
const BESIDE_M: f64 = 0.003;
const ABOVE_M: f64 = 0.004;
/// Closed pads hold a block whose centre is horizontally within this distance, metres.
const HELD_WITHIN_M: f64 = 0.025;
/// Height above the table at which a held block counts as set down, metres, because cameras are not exact.
const SET_DOWN_M: f64 = 0.002;
/// Additional distance beside a block for tilted pads, metres at a tilt of 90 degrees.
const TILTED_M: f64 = 0.010;

/// A block as observed, world frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct ObservedBlock {
    /// The centre, metres.
    pub(crate) at: DVec3,
    /// The rotation about the vertical axis, radians.
    pub(crate) yaw_rad: f64,
    /// Half the edges, along the block's own axes, metres.
    pub(crate) half_m: DVec3,
}

/// The pads of a hand that is to move.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Pads {
    /// The closing direction, world frame, as an angle about the vertical axis, radians.
    pub(crate) yaw_rad: f64,
    /// The opening of each side, metres.
    pub(crate) opening_m: f64,
    /// The largest angle between the gripper and the vertical on the path, radians.
    pub(crate) tilt_rad: f64,
}

/// Returns `to`, but no lower than the blocks that pads at `from` hold can be lowered; world frame, metres.
pub(crate) fn lowered(from: DVec3, to: DVec3, pads: &Pads, blocks: &[ObservedBlock]) -> DVec3 {
    let room_m = blocks.iter().filter(|block| pads.hold(from, block)).map(ObservedBlock::room_m);
    to.with_z(to.z.max(from.z - room_m.fold(f64::INFINITY, f64::min)))
}

/// Returns the path of the point between the pads from `from` towards `to`, world frame, metres: a corner and the end.
pub(crate) fn avoid_blocks(
    from: DVec3,
    to: DVec3,
    pads: &Pads,
    blocks: &[ObservedBlock],
) -> [DVec3; 2] {
    let to = lowered(from, to, pads, blocks);
    let (sin, cos) = libm::sincos(pads.tilt_rad);
    let reach_m = PADS_BELOW_M * cos + PAD_HALF_M.x * sin;
    let was_above = |block: &&ObservedBlock| from.z - reach_m >= block.top_m() - ABOVE_M;
    if to.z >= from.z {
        return [from.midpoint(to), to];
    }
    if blocks.iter().filter(was_above).count() == 0 {
        return [from.with_z(to.z), to];
    }
    let blocked = |block: &&ObservedBlock| pads.overlap(to, block);
    let lowest_m = blocks
        .iter()
        .filter(was_above)
        .filter(blocked)
        .map(|block| block.top_m() + reach_m + ABOVE_M)
        .fold(f64::NEG_INFINITY, f64::max);
    let end = to.with_z(to.z.max(lowest_m.min(from.z)));
    [end.with_z(from.z), end]
}

impl ObservedBlock {
    /// The distance by which the block can be lowered, metres.
    fn room_m(&self) -> f64 {
        (self.at.z - self.half_m.z - SET_DOWN_M).max(0.0)
    }

    fn top_m(&self) -> f64 {
        self.at.z + self.half_m.z
    }
}

impl Pads {
    /// Returns whether pads around `centre` hold `block`.
    fn hold(&self, centre: DVec3, block: &ObservedBlock) -> bool {
        let offset = block.at - centre;
        let longer_m = (block.half_m.x - block.half_m.y).max(0.0);
        self.opening_m <= block.half_m.y
            && offset.truncate().length() < HELD_WITHIN_M + longer_m
            && offset.z.abs() < block.half_m.z
    }

    /// Returns whether pads around `centre` are above `block` or too near to it.
    fn overlap(&self, centre: DVec3, block: &ObservedBlock) -> bool {
        let room_m = BESIDE_M + TILTED_M * libm::sin(self.tilt_rad);
        let closing = direction(self.yaw_rad);
        let cube = Rectangle {
            at: block.at.truncate(),
            along: direction(block.yaw_rad),
            half: block.half_m.truncate() + room_m,
        };
        [1.0, -1.0].into_iter().any(|side| {
            let offset = closing * (side * (self.opening_m + PAD_HALF_M.y));
            let half = DVec2::new(PAD_HALF_M.y, PAD_HALF_M.x);
            let pad = Rectangle { at: centre.truncate() + offset, along: closing, half };
            pad.overlaps(&cube)
        })
    }
}

/// A rectangle on the table.
struct Rectangle {
    at: DVec2,
    /// The direction of the first edge.
    along: DVec2,
    half: DVec2,
}

impl Rectangle {
    fn overlaps(&self, other: &Self) -> bool {
        let axes = [self.along, self.along.perp(), other.along, other.along.perp()];
        let apart = other.at - self.at;
        axes.iter().all(|axis| apart.dot(*axis).abs() < self.width(*axis) + other.width(*axis))
    }

    /// Half the width along `axis`.
    fn width(&self, axis: DVec2) -> f64 {
        self.half.x * self.along.dot(axis).abs() + self.half.y * self.along.perp().dot(axis).abs()
    }
}

fn direction(angle_rad: f64) -> DVec2 {
    let (sin, cos) = libm::sincos(angle_rad);
    DVec2::new(cos, sin)
}

#[cfg(test)]
mod tests {
    use super::*;

    const BLOCK: ObservedBlock = ObservedBlock {
        at: DVec3::new(0.1, 0.0, 0.028),
        yaw_rad: 0.0,
        half_m: DVec3::splat(0.028),
    };
    const OPEN: Pads =
        Pads { yaw_rad: std::f64::consts::FRAC_PI_2, opening_m: 0.05, tilt_rad: 0.0 };

    #[test]
    fn open_pads_descend_around_a_block_and_closed_ones_stay_above() {
        let (from, to) = (DVec3::new(0.07, 0.0, 0.12), DVec3::new(0.1, 0.0, 0.03));
        let corner = DVec3::new(0.1, 0.0, 0.12);
        assert_eq!(avoid_blocks(from, to, &OPEN, &[BLOCK]), [corner, to]);
        let shut = Pads { opening_m: 0.0, ..OPEN };
        let [_, end] = avoid_blocks(from, to, &shut, &[BLOCK]);
        assert!((end.z - (0.056 + PADS_BELOW_M + ABOVE_M)).abs() < 1e-12, "{end}");
        let turned = ObservedBlock { yaw_rad: std::f64::consts::FRAC_PI_4, ..BLOCK };
        let narrow = Pads { opening_m: 0.033, ..OPEN };
        assert_eq!(avoid_blocks(from, to, &narrow, &[BLOCK])[1], to);
        assert!(avoid_blocks(from, to, &narrow, &[turned])[1].z > 0.07, "a corner is under a pad");
    }

    #[test]
    fn a_held_block_is_lowered_to_the_table_and_no_further() {
        let held = ObservedBlock { at: BLOCK.at.with_z(0.06), ..BLOCK };
        let from = DVec3::new(0.1, 0.005, 0.07);
        let to = from.with_z(0.03);
        let shut = Pads { opening_m: 0.02, ..OPEN };
        let [_, end] = avoid_blocks(from, to, &shut, &[held]);
        assert!((end.z - (0.07 - (0.06 - 0.028 - SET_DOWN_M))).abs() < 1e-12, "{end}");
        let [_, end] = avoid_blocks(from, from.with_z(0.04), &OPEN, &[BLOCK]);
        assert!((end.z - 0.04).abs() < 1e-12, "nothing is held by an open gripper");
    }

    #[test]
    fn a_hand_beside_a_block_moves_down_before_it_pushes() {
        let (from, to) = (DVec3::new(0.04, 0.0, 0.04), DVec3::new(0.08, 0.0, 0.03));
        assert_eq!(avoid_blocks(from, to, &OPEN, &[BLOCK]), [from.with_z(0.03), to]);
        let up = from.with_z(0.1);
        assert_eq!(avoid_blocks(from, up, &OPEN, &[BLOCK]), [from.midpoint(up), up]);
    }
}
