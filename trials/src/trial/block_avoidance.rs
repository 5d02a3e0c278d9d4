//! The path of one step around the blocks: sideways before down, and down only where there is room.
//!
//! In the training world a hand that descends on a block rests on it and slides along. An arm would press until the
//! envelope stops it. A hand above the top of a block that it crosses therefore moves sideways first, raised before if
//! its pads or the block that they hold would graze the other block, and stays just above a block that these would
//! touch. A hand beside a block moves down first and then sideways, because pads that descend along a block's side
//! press it onto the table. A hand that holds a block lowers it to the table and no further.

use glam::{DMat3, DVec2, DVec3};

use crate::simulated::PAD_HALF_M;

/// Distances that are kept beside and above a block, metres.
const CLEARANCE_BESIDE_M: f64 = 0.003;
const CLEARANCE_ABOVE_M: f64 = 0.004;
/// Closed pads hold a block whose centre is horizontally within this distance, metres.
const HOLDING_DISTANCE_M: f64 = 0.025;
/// The number of parts of a step at whose ends pads are compared with a block.
const N_PARTS: u32 = 8;
/// A hand is held up if it ends this far above its wanted position, metres.
const HELD_UP_HEIGHT_M: f64 = 0.01;
/// Height above the table at which a held block counts as set down, metres, because cameras are not exact.
const SET_DOWN_HEIGHT_M: f64 = 0.002;

/// A block as observed, world frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct ObservedBlock {
    /// The centre, metres.
    pub(crate) position: DVec3,
    /// The rotation about the vertical axis, radians.
    pub(crate) yaw_rad: f64,
    /// Half the edges, along the block's own axes, metres.
    pub(crate) half_m: DVec3,
}

/// The pads of a hand, world frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Pads {
    /// The point between the pads, metres.
    pub(crate) centre: DVec3,
    /// The closing direction, the direction across it and the direction in which the hand points, as columns. The
    /// closing direction of a tilted hand is level only if the hand tilts across it.
    pub(crate) axes: DMat3,
    /// The opening of each side, metres.
    pub(crate) opening_m: f64,
    /// The commanded opening of each side, metres. It is smaller if the pads hold something.
    pub(crate) commanded_m: f64,
}

/// The path of a step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct StepPath {
    /// Two corners and the end of the path of the point between the pads, world frame, metres.
    pub(crate) points: [DVec3; 3],
    /// Whether a block keeps the hand from reaching its wanted position.
    pub(crate) is_held_up: bool,
}

/// Returns `to`, but no lower than the blocks that pads at `from` hold can be lowered; world frame, metres.
pub(crate) fn lowered(from: &Pads, to: DVec3, blocks: &[ObservedBlock]) -> DVec3 {
    let room_m = blocks.iter().filter(|block| from.hold(block)).map(ObservedBlock::room_m);
    to.with_z(to.z.max(from.centre.z - room_m.fold(f64::INFINITY, f64::min)))
}

/// Returns the path of the point between the pads from `from` towards `to`.
pub(crate) fn avoid_blocks(from: &Pads, to: &Pads, blocks: &[ObservedBlock]) -> StepPath {
    let start = from.centre;
    let to = Pads { centre: lowered(from, to.centre, blocks), ..*to };
    let end = to.centre;
    let free = |corner| StepPath { points: [start, corner, end], is_held_up: false };
    if end.z >= start.z {
        return free(start.midpoint(end));
    }
    let (held, others): (Vec<ObservedBlock>, Vec<_>) =
        blocks.iter().partition(|block| from.hold(block));
    let moved =
        |block: &ObservedBlock| (Body::at(block, DVec3::ZERO), Body::at(block, end - start));
    let pads = from.each().into_iter().zip(to.each());
    let bodies: Vec<(Body, Body)> = pads.chain(held.iter().map(moved)).collect();
    let mut is_above = false;
    let mut lowest_m = f64::NEG_INFINITY;
    let mut lift_m = 0.0_f64;
    let is_met = |block: &&ObservedBlock| {
        from.crosses(&to, block) || bodies[2..].iter().any(|(one, then)| one.crosses(then, block))
    };
    for block in others.iter().filter(is_met) {
        let over_m = block.top_m() + CLEARANCE_ABOVE_M;
        let any_above = bodies.iter().any(|(before, _)| before.is_above(block));
        for (before, after) in &bodies {
            let crosses = || any_above && !before.overlaps(block) && before.crosses(after, block);
            if before.is_above(block) || crosses() {
                is_above = true;
                lift_m = lift_m.max(over_m - before.lowest_m());
                if after.overlaps(block) {
                    lowest_m = lowest_m.max(over_m + end.z - after.lowest_m());
                }
            }
        }
    }
    if !is_above {
        return free(start.with_z(end.z));
    }
    let highest_m = start.z + lift_m;
    let last = end.with_z(end.z.max(lowest_m.min(highest_m)));
    let points = [start.with_z(highest_m), last.with_z(highest_m), last];
    StepPath { points, is_held_up: last.z > end.z + HELD_UP_HEIGHT_M }
}

impl ObservedBlock {
    /// The distance by which the block can be lowered, metres.
    fn room_m(&self) -> f64 {
        (self.position.z - self.half_m.z - SET_DOWN_HEIGHT_M).max(0.0)
    }

    fn top_m(&self) -> f64 {
        self.position.z + self.half_m.z
    }
}

impl Pads {
    /// Returns whether the pads hold `block`.
    fn hold(&self, block: &ObservedBlock) -> bool {
        let offset = block.position - self.centre;
        let longer_m = (block.half_m.x - block.half_m.y).max(0.0);
        self.commanded_m <= block.half_m.y
            && offset.truncate().length() < HOLDING_DISTANCE_M + longer_m
            && offset.z.abs() < block.half_m.z
    }

    /// Returns whether a pad, or what is between the pads, overlaps `block`, seen from above, on the way to `to`.
    fn crosses(&self, to: &Self, block: &ObservedBlock) -> bool {
        (0..=N_PARTS).any(|part| {
            let centre = self.centre.lerp(to.centre, share(part));
            let between = Body { centre, axes: to.axes, half_m: PAD_HALF_M };
            let [one, other] = Self { centre, ..*to }.each();
            [one, between, other].iter().any(|body| body.overlaps(block))
        })
    }

    /// Each of the two pads.
    fn each(&self) -> [Body; 2] {
        [1.0, -1.0].map(|side| {
            let offset = self.axes.x_axis * (side * (self.opening_m + PAD_HALF_M.x));
            Body { centre: self.centre + offset, axes: self.axes, half_m: PAD_HALF_M }
        })
    }
}

/// A pad or a held block, world frame, metres.
struct Body {
    centre: DVec3,
    axes: DMat3,
    /// Half the edges, along the axes.
    half_m: DVec3,
}

impl Body {
    /// `block`, displaced by `by`.
    fn at(block: &ObservedBlock, by: DVec3) -> Self {
        let axes = DMat3::from_rotation_z(block.yaw_rad);
        Self { centre: block.position + by, axes, half_m: block.half_m }
    }

    /// The height of the lowest corner.
    fn lowest_m(&self) -> f64 {
        self.centre.z - self.half_width_m(DVec3::Z)
    }

    fn is_above(&self, block: &ObservedBlock) -> bool {
        self.lowest_m() >= block.top_m() - CLEARANCE_ABOVE_M
    }

    /// Half the width along `axis`.
    fn half_width_m(&self, axis: DVec3) -> f64 {
        self.half_m.dot((self.axes.transpose() * axis).abs())
    }

    /// Returns whether the body is above `block` or too near to it, seen from above.
    fn overlaps(&self, block: &ObservedBlock) -> bool {
        let cube = Rectangle {
            along: direction(block.yaw_rad),
            half: block.half_m.truncate() + CLEARANCE_BESIDE_M,
        };
        let closing = self.axes.x_axis.truncate().normalize_or(DVec2::X);
        let apart = (block.position - self.centre).truncate();
        [closing, closing.perp(), cube.along, cube.along.perp()].into_iter().all(|axis| {
            apart.dot(axis).abs() < self.half_width_m(axis.extend(0.0)) + cube.half_width_m(axis)
        })
    }

    /// Returns whether the body overlaps `block` on the way to `to`.
    fn crosses(&self, to: &Self, block: &ObservedBlock) -> bool {
        (0..=N_PARTS).any(|part| {
            Self { centre: self.centre.lerp(to.centre, share(part)), ..*to }.overlaps(block)
        })
    }
}

/// The share of a step after `part` of its [`N_PARTS`].
fn share(part: u32) -> f64 {
    f64::from(part) / f64::from(N_PARTS)
}

/// A rectangle on the table, metres.
struct Rectangle {
    /// The direction of the first edge.
    along: DVec2,
    half: DVec2,
}

impl Rectangle {
    /// Half the width along `axis`.
    fn half_width_m(&self, axis: DVec2) -> f64 {
        self.half.x * self.along.dot(axis).abs() + self.half.y * self.along.perp().dot(axis).abs()
    }
}

/// Returns the unit vector at an angle from x.
pub(crate) fn direction(angle_rad: f64) -> DVec2 {
    let (sin, cos) = libm::sincos(angle_rad);
    DVec2::new(cos, sin)
}

#[cfg(test)]
mod tests {
    use super::*;

    const BLOCK: ObservedBlock = ObservedBlock {
        position: DVec3::new(0.1, 0.0, 0.028),
        yaw_rad: 0.0,
        half_m: DVec3::splat(0.028),
    };

    /// Pads of an upright hand that close along y.
    fn pads(centre: DVec3, opening_m: f64) -> Pads {
        let axes = DMat3::from_cols(DVec3::Y, DVec3::X, DVec3::NEG_Z);
        Pads { centre, axes, opening_m, commanded_m: opening_m }
    }

    #[test]
    fn open_pads_descend_around_a_block_and_closed_ones_stay_above() {
        let (from, to) = (DVec3::new(0.07, 0.0, 0.12), DVec3::new(0.1, 0.0, 0.03));
        let path =
            |opening_m, block| avoid_blocks(&pads(from, opening_m), &pads(to, opening_m), &[block]);
        let open = path(0.05, BLOCK);
        assert_eq!(
            open,
            StepPath { points: [from, DVec3::new(0.1, 0.0, 0.12), to], is_held_up: false }
        );
        let closed = path(0.0, BLOCK);
        let end = closed.points[2];
        assert!((end.z - (0.056 + PAD_HALF_M.z + CLEARANCE_ABOVE_M)).abs() < 1e-12, "{end}");
        assert!(closed.is_held_up);
        let turned = ObservedBlock { yaw_rad: std::f64::consts::FRAC_PI_4, ..BLOCK };
        assert_eq!(path(0.033, BLOCK).points[2], to);
        assert!(path(0.033, turned).points[2].z > 0.07, "a corner is under a pad");
    }

    #[test]
    fn the_lower_pad_of_a_tilted_hand_stays_above_a_block() {
        let tilted = |centre| {
            let open = pads(centre, 0.05);
            // About x, so that the pad at positive y is lower.
            Pads { axes: DMat3::from_rotation_x(-0.4) * open.axes, ..open }
        };
        let beside = DVec3::new(0.1, -0.06, 0.12);
        let (from, to) = (tilted(beside), tilted(beside.with_z(0.03)));
        let [.., end] = avoid_blocks(&from, &to, &[BLOCK]).points;
        let lower = tilted(end).each().map(|pad| pad.lowest_m());
        assert!(lower[0] < lower[1] - 0.03, "{lower:?}");
        assert!((lower[0] - (0.056 + CLEARANCE_ABOVE_M)).abs() < 1e-12, "{lower:?}");
    }

    #[test]
    fn pads_that_would_graze_a_block_cross_it_higher() {
        let grazing = 0.056 + PAD_HALF_M.z - 0.001;
        let from = DVec3::new(0.04, 0.0, grazing);
        let to = DVec3::new(0.16, 0.0, 0.03);
        let [raised, corner, end] = avoid_blocks(&pads(from, 0.0), &pads(to, 0.0), &[BLOCK]).points;
        assert!((raised - from.with_z(grazing + 0.005)).length() < 1e-12, "{raised}");
        assert_eq!([corner, end], [to.with_z(raised.z), to]);
    }

    #[test]
    fn a_pad_that_starts_below_the_top_does_not_land_on_a_block_either() {
        // One pad is above the block. The other one is beside it, slightly lower than its top.
        let from = DVec3::new(0.1, -0.06, 0.056 + PAD_HALF_M.z);
        let tilted = |centre| {
            let open = pads(centre, 0.03);
            Pads { axes: DMat3::from_rotation_x(0.2) * open.axes, ..open }
        };
        let (from, to) = (tilted(from), tilted(DVec3::new(0.1, 0.03, 0.05)));
        let is_above = from.each().map(|pad| pad.is_above(&BLOCK));
        assert_eq!(is_above, [true, false]);
        let path = avoid_blocks(&from, &to, &[BLOCK]);
        let lowest_m = tilted(path.points[2]).each().map(|pad| pad.lowest_m());
        assert!(lowest_m[1] >= 0.056 + CLEARANCE_ABOVE_M - 1e-12, "{lowest_m:?}");
        assert!(path.is_held_up);
    }

    #[test]
    fn a_held_block_passes_over_another_one() {
        let from = DVec3::new(0.1, 0.07, 0.09);
        let held = ObservedBlock { position: from, ..BLOCK };
        let holding = |centre| Pads { commanded_m: 0.0, ..pads(centre, 0.028) };
        let to = DVec3::new(0.1, 0.0, 0.05);
        let path = avoid_blocks(&holding(from), &holding(to), &[held, BLOCK]);
        let lowest_m = path.points[2].z - 0.028;
        assert!((lowest_m - (0.056 + CLEARANCE_ABOVE_M)).abs() < 1e-12, "{lowest_m}");
        assert!(path.is_held_up);
        let alone = avoid_blocks(&holding(from), &holding(to), &[held]);
        assert_eq!(alone.points[2], to);
    }

    #[test]
    fn a_block_that_a_hand_does_not_cross_does_not_change_its_path() {
        let far = ObservedBlock { position: BLOCK.position + DVec3::Y * 0.3, ..BLOCK };
        let high = ObservedBlock {
            half_m: DVec3::splat(0.04),
            position: BLOCK.position.with_z(0.04),
            ..BLOCK
        };
        let from = DVec3::new(0.03, 0.0, 0.072);
        let path = |blocks: &[ObservedBlock]| {
            avoid_blocks(&pads(from, 0.0), &pads(DVec3::new(0.08, 0.0, 0.03), 0.0), blocks)
        };
        assert_eq!(
            path(&[high, far]).points[1],
            from.with_z(0.03),
            "beside one block, above another"
        );
    }

    #[test]
    fn a_held_block_is_lowered_to_the_table_and_no_further() {
        let held = ObservedBlock { position: BLOCK.position.with_z(0.06), ..BLOCK };
        let from = DVec3::new(0.1, 0.005, 0.07);
        let path = |opening_m, to, block| {
            avoid_blocks(&pads(from, opening_m), &pads(to, opening_m), &[block])
        };
        let [.., end] = path(0.02, from.with_z(0.03), held).points;
        assert!((end.z - (0.07 - (0.06 - 0.028 - SET_DOWN_HEIGHT_M))).abs() < 1e-12, "{end}");
        let [.., end] = path(0.05, from.with_z(0.04), BLOCK).points;
        assert!((end.z - 0.04).abs() < 1e-12, "nothing is held by an open gripper");
    }

    #[test]
    fn a_hand_beside_a_block_moves_down_before_it_pushes() {
        let from = DVec3::new(0.04, 0.0, 0.04);
        let path = |to| avoid_blocks(&pads(from, 0.05), &pads(to, 0.05), &[BLOCK]).points;
        let to = DVec3::new(0.08, 0.0, 0.03);
        assert_eq!(path(to), [from, from.with_z(0.03), to]);
        let up = from.with_z(0.1);
        assert_eq!(path(up), [from, from.midpoint(up), up]);
    }
}
