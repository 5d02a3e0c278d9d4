//! The way of one step round the blocks: sideways before down, and down only where there is room.
//!
//! In the training world a hand that comes down on a block is held up by it and slides on. An arm would press until the
//! envelope stops it. So a hand above a block's top goes sideways first; where its pads would then come down on
//! a block it stays just above. A hand beside a block goes down first and then sideways: pads that come down along a block's
//! side press it on the table. And what a hand holds it lowers to the table and no further.

use glam::{DVec2, DVec3};

/// Half a pad's width across the closing direction and half its thickness, metres; a little more than the real ones.
const PAD_HALF_M: DVec2 = DVec2::new(0.008, 0.005);
/// The pads' lower ends below the point between them, metres.
const PADS_BELOW_M: f64 = 0.015;
/// Room that is kept beside a block, and above it, metres.
const BESIDE_M: f64 = 0.003;
const ABOVE_M: f64 = 0.004;
/// A block between shut pads is held when its centre is so near, horizontally, metres.
const HELD_WITHIN_M: f64 = 0.025;
/// Height above the table at which a block that is held counts as set down, metres: cameras are not exact.
const SET_DOWN_M: f64 = 0.002;
/// Room to be added beside a block for pads that are not upright, metres for a gripper that lies.
const TILTED_M: f64 = 0.010;

/// A block as it was seen, world frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct SeenBlock {
    /// Its centre, metres.
    pub(crate) at: DVec3,
    /// How it is turned about the upright axis, radians.
    pub(crate) yaw_rad: f64,
    /// Half an edge, metres.
    pub(crate) half_m: f64,
}

/// The pads of a hand that is to move.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Pads {
    /// Direction in which they close, world frame, as an angle about the upright axis, radians.
    pub(crate) yaw_rad: f64,
    /// How far each side is open, metres.
    pub(crate) opening_m: f64,
    /// The largest angle between the gripper and straight down on the way, radians.
    pub(crate) tilt_rad: f64,
}

/// Where the point between the pads shall go on its way from `from` to `to`, world frame, metres: a corner and the end.
pub(crate) fn way(from: DVec3, to: DVec3, pads: &Pads, blocks: &[SeenBlock]) -> [DVec3; 2] {
    let room_m = blocks.iter().filter(|block| pads.hold(from, block)).map(SeenBlock::room_m);
    let to = to.with_z(to.z.max(from.z - room_m.fold(f64::INFINITY, f64::min)));
    let (sin, cos) = libm::sincos(pads.tilt_rad);
    let reach_m = PADS_BELOW_M * cos + PAD_HALF_M.x * sin;
    let was_above = |block: &&SeenBlock| from.z - reach_m >= block.top_m() - ABOVE_M;
    if to.z >= from.z {
        return [from.midpoint(to), to];
    }
    if blocks.iter().filter(was_above).count() == 0 {
        return [from.with_z(to.z), to];
    }
    let blocked = |block: &&SeenBlock| pads.overlap(to, block);
    let lowest_m = blocks
        .iter()
        .filter(was_above)
        .filter(blocked)
        .map(|block| block.top_m() + reach_m + ABOVE_M)
        .fold(f64::NEG_INFINITY, f64::max);
    let end = to.with_z(to.z.max(lowest_m.min(from.z)));
    [end.with_z(from.z), end]
}

impl SeenBlock {
    /// How far it may be lowered, metres.
    fn room_m(&self) -> f64 {
        (self.at.z - self.half_m - SET_DOWN_M).max(0.0)
    }

    fn top_m(&self) -> f64 {
        self.at.z + self.half_m
    }
}

impl Pads {
    /// Whether pads about `centre` hold `block`.
    fn hold(&self, centre: DVec3, block: &SeenBlock) -> bool {
        let offset = block.at - centre;
        self.opening_m <= block.half_m
            && offset.truncate().length() < HELD_WITHIN_M
            && offset.z.abs() < block.half_m
    }

    /// Whether pads about `centre` stand over `block` or too near beside it.
    fn overlap(&self, centre: DVec3, block: &SeenBlock) -> bool {
        let room_m = BESIDE_M + TILTED_M * libm::sin(self.tilt_rad);
        let closing = direction(self.yaw_rad);
        let cube = Rectangle {
            at: block.at.truncate(),
            along: direction(block.yaw_rad),
            half: DVec2::splat(block.half_m + room_m),
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
    /// Direction of its first edge.
    along: DVec2,
    half: DVec2,
}

impl Rectangle {
    fn overlaps(&self, other: &Self) -> bool {
        let axes = [self.along, self.along.perp(), other.along, other.along.perp()];
        let apart = other.at - self.at;
        axes.iter().all(|axis| apart.dot(*axis).abs() < self.width(*axis) + other.width(*axis))
    }

    /// Half its width along `axis`.
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

    const BLOCK: SeenBlock =
        SeenBlock { at: DVec3::new(0.1, 0.0, 0.028), yaw_rad: 0.0, half_m: 0.028 };
    const OPEN: Pads =
        Pads { yaw_rad: std::f64::consts::FRAC_PI_2, opening_m: 0.05, tilt_rad: 0.0 };

    #[test]
    fn open_pads_come_down_round_a_block_and_shut_ones_stay_above() {
        let (from, to) = (DVec3::new(0.07, 0.0, 0.12), DVec3::new(0.1, 0.0, 0.03));
        let corner = DVec3::new(0.1, 0.0, 0.12);
        assert_eq!(way(from, to, &OPEN, &[BLOCK]), [corner, to]);
        let shut = Pads { opening_m: 0.0, ..OPEN };
        let [_, end] = way(from, to, &shut, &[BLOCK]);
        assert!((end.z - (0.056 + PADS_BELOW_M + ABOVE_M)).abs() < 1e-12, "{end}");
        let turned = SeenBlock { yaw_rad: std::f64::consts::FRAC_PI_4, ..BLOCK };
        let narrow = Pads { opening_m: 0.033, ..OPEN };
        assert_eq!(way(from, to, &narrow, &[BLOCK])[1], to);
        assert!(way(from, to, &narrow, &[turned])[1].z > 0.07, "a corner is under a pad");
    }

    #[test]
    fn what_is_held_is_lowered_to_the_table_and_no_further() {
        let held = SeenBlock { at: BLOCK.at.with_z(0.06), ..BLOCK };
        let from = DVec3::new(0.1, 0.005, 0.07);
        let to = from.with_z(0.03);
        let shut = Pads { opening_m: 0.02, ..OPEN };
        let [_, end] = way(from, to, &shut, &[held]);
        assert!((end.z - (0.07 - (0.06 - 0.028 - SET_DOWN_M))).abs() < 1e-12, "{end}");
        let [_, end] = way(from, from.with_z(0.04), &OPEN, &[BLOCK]);
        assert!((end.z - 0.04).abs() < 1e-12, "nothing is held by an open gripper");
    }

    #[test]
    fn a_hand_beside_a_block_goes_down_before_it_pushes() {
        let (from, to) = (DVec3::new(0.04, 0.0, 0.04), DVec3::new(0.08, 0.0, 0.03));
        assert_eq!(way(from, to, &OPEN, &[BLOCK]), [from.with_z(0.03), to]);
        let up = from.with_z(0.1);
        assert_eq!(way(from, up, &OPEN, &[BLOCK]), [from.midpoint(up), up]);
    }
}
