//! Initial states in the shared world.
//!
//! Objects and goals of both arms lie in one area of the table, which is the same for an arm alone. Two arms can serve
//! their objects one after the other: in at least one order, neither object is in the way of the other one.

use std::f32::consts::FRAC_PI_4;

use rand_chacha::ChaCha8Rng;
use rapier3d::math::Vector;
use tandem_core::rng::{bernoulli, uniform};
use tandem_core::{ArmIndex, Layout, World, WorldSettings};

use crate::frame::ArmFrame;
use crate::mico::{Mico, hypotenuse};
use crate::parameters::WorldParameters;
use crate::reach::Reach;
use crate::start::{ArmStart, all_pairs, diagonal_m, horizontal};

/// Range of objects and goals along x, arm frame, metres.
pub(super) const AREA_X_M: [f32; 2] = [0.0, 0.20];
/// Half extent of their area along y, metres.
pub(super) const AREA_Y_M: f32 = 0.15;
/// Horizontal room for a hand behind an object, metres: half the object's diagonal, and a pad.
const ROOM_BEHIND_M: f32 = 0.055;
/// Smallest distance between an object and its goal, metres; more than the tolerance, which an object that settles
/// cannot close.
const GOAL_DISTANCE_M: f32 = 0.07;
/// Smallest distance between two objects, metres: an open gripper fits between them.
const OBJECT_SEPARATION_M: f32 = 0.12;
/// Smallest horizontal distance between two goals, and between the way of an object and another object, metres.
const CLEARANCE_M: f32 = 0.10;
/// Smallest horizontal distance between two hands, metres.
const HAND_SEPARATION_M: f32 = 0.17;
/// Height of a goal above the table from which a hand must hold its object there, metres.
const HOLD_HEIGHT_M: f32 = 0.03;
/// Smallest distance along y, metres, at which a hand passes the forearm of an arm that holds its object.
const PASSING_M: f32 = 0.22;
/// Height of the end effector from which a hand is clear of objects with edges of up to 7.2 cm, metres.
const CLEAR_HEIGHT_M: f32 = 0.11;
/// Gap between the open fingers and an object, metres.
const FINGER_GAP_M: f32 = 0.01;
/// Probability that a drawn pick-and-place goal is above the table. Starts with such goals are rejected more often, because
/// hands do not reach all of them: of the goals of two arms, 0.43 are above the table.
const AIR_GOAL_PROB: f32 = 0.5;
/// Largest height of such a goal above the table, metres.
pub(super) const AIR_GOAL_HIGH_M: f32 = 0.30;
/// Largest offset of a grasped object from the centre of the pads along x and z, metres.
const GRASPED_OFFSET_M: [f32; 2] = [0.004, 0.008];

/// The parameters of the distributions.
struct Sampler {
    layout: Layout,
    object_half_m: f32,
    grasped: bool,
    parameters: &'static WorldParameters,
    mico: Mico,
}

/// An object's positions at the start and at its goal, world frame, metres.
struct Way {
    from: Vector,
    to: Vector,
    /// The frame of the arm that moves it.
    frame: ArmFrame,
}

/// Draws the initial state of every arm.
pub(super) fn sample(
    rng: &mut ChaCha8Rng,
    layout: Layout,
    object_half_m: f32,
    settings: WorldSettings,
) -> Vec<ArmStart> {
    let parameters = WorldParameters::of(World::Shared);
    let can_hold = layout.task.grasps() && object_half_m < parameters.gripper.max_opening_m;
    let grasped = bernoulli(rng, settings.grasped_start_prob) && can_hold;
    let mico = Mico::in_shared_world();
    let sampler = Sampler { layout, object_half_m, grasped, parameters, mico };
    loop {
        let arms: Vec<ArmStart> = layout.arms().map(|_| sampler.arm_start(rng)).collect();
        if sampler.is_valid(&arms) {
            return arms;
        }
    }
}

impl Sampler {
    fn arm_start(&self, rng: &mut ChaCha8Rng) -> ArmStart {
        let goal = self.goal(rng);
        if self.grasped {
            let end_effector = self.grasping_hand(rng);
            let object = self.grasped_object(rng, end_effector);
            return ArmStart {
                end_effector,
                opening_m: self.object_half_m,
                object,
                object_yaw_rad: self.grasped_yaw_rad(end_effector),
                holds_object: true,
                goal,
            };
        }
        ArmStart {
            end_effector: self.hand(rng),
            opening_m: self.empty_opening_m(),
            object: self.object(rng),
            // A cube looks the same after a quarter of a turn.
            object_yaw_rad: uniform(rng, -FRAC_PI_4, FRAC_PI_4),
            holds_object: false,
            goal,
        }
    }

    /// Draws an object that a hand can go around.
    fn object(&self, rng: &mut ChaCha8Rng) -> Vector {
        let [_, far_m] = Reach::MICO.radii_m(0.0);
        loop {
            let object = self.point_on_table(rng);
            if Reach::MICO.radius_m(object.to_array()) + ROOM_BEHIND_M <= far_m {
                return object;
            }
        }
    }

    /// Draws a goal that a hand reaches.
    fn goal(&self, rng: &mut ChaCha8Rng) -> Vector {
        loop {
            let on_table = self.point_on_table(rng);
            let in_air = self.layout.task.grasps() && bernoulli(rng, AIR_GOAL_PROB);
            let height_m = if in_air { uniform(rng, 0.0, AIR_GOAL_HIGH_M) } else { 0.0 };
            let goal = on_table + Vector::Z * height_m;
            let [_, offset_z_m] = GRASPED_OFFSET_M;
            let holding = goal.with_z(goal.z.max(self.parameters.workspace_low.z) + offset_z_m);
            if !in_air || self.parameters.contains(holding) {
                return goal;
            }
        }
    }

    fn point_on_table(&self, rng: &mut ChaCha8Rng) -> Vector {
        let x_m = uniform(rng, AREA_X_M[0], AREA_X_M[1]);
        Vector::new(x_m, uniform(rng, -AREA_Y_M, AREA_Y_M), self.object_half_m)
    }

    /// Draws any position of the end effector.
    fn hand(&self, rng: &mut ChaCha8Rng) -> Vector {
        let (low, high) = (self.parameters.workspace_low, self.parameters.workspace_high);
        self.hand_in(rng, low, high)
    }

    /// Draws a position of the end effector above the area of the objects.
    fn grasping_hand(&self, rng: &mut ChaCha8Rng) -> Vector {
        let [_, offset_z_m] = GRASPED_OFFSET_M;
        let low_z_m = self.parameters.workspace_low.z.max(self.object_half_m + offset_z_m);
        let low = Vector::new(AREA_X_M[0], -AREA_Y_M, low_z_m);
        let high = Vector::new(AREA_X_M[1], AREA_Y_M, self.parameters.workspace_high.z);
        self.hand_in(rng, low, high)
    }

    fn hand_in(&self, rng: &mut ChaCha8Rng, low: Vector, high: Vector) -> Vector {
        loop {
            let drawn = low.to_array().map(|low_m| (low_m, uniform(rng, 0.0, 1.0)));
            let at = |axis: usize| drawn[axis].0 + (high[axis] - low[axis]) * drawn[axis].1;
            let hand = Vector::new(at(0), at(1), at(2));
            if self.parameters.contains(hand) {
                return hand;
            }
        }
    }

    fn grasped_object(&self, rng: &mut ChaCha8Rng, hand: Vector) -> Vector {
        let [offset_x_m, offset_z_m] = GRASPED_OFFSET_M;
        let offset_x_m = uniform(rng, -offset_x_m, offset_x_m);
        let offset_z_m = uniform(rng, -offset_z_m, offset_z_m);
        let z_m = (hand.z + offset_z_m).max(self.object_half_m);
        Vector::new(hand.x + offset_x_m, hand.y, z_m)
    }

    /// Returns the rotation about the vertical axis of a cube between the pads of a hand, radians.
    fn grasped_yaw_rad(&self, hand: Vector) -> f32 {
        let closing = self.mico.posture(hand).orientation() * Vector::Y;
        libm::atan2f(-closing.x, closing.y)
    }

    /// Returns the opening of each side of an empty gripper, metres.
    fn empty_opening_m(&self) -> f32 {
        if self.layout.task.grasps() { self.parameters.gripper.max_opening_m } else { 0.0 }
    }

    fn is_valid(&self, arms: &[ArmStart]) -> bool {
        let frame = |arm: usize| ArmFrame::new(ArmIndex(arm), self.layout.n_arms);
        let in_world = |arm: usize, point| frame(arm).world_from_arm(point);
        let points = |part: fn(&ArmStart) -> Vector| -> Vec<Vector> {
            arms.iter().enumerate().map(|(arm, start)| in_world(arm, part(start))).collect()
        };
        let hands = points(|start| start.end_effector);
        let (objects, goals) = (points(|start| start.object), points(|start| start.goal));
        let ways: Vec<Way> = objects
            .iter()
            .zip(&goals)
            .enumerate()
            .map(|(arm, (&from, &to))| Way { from, to, frame: frame(arm) })
            .collect();
        arms.iter().all(|start| (start.object - start.goal).length() >= GOAL_DISTANCE_M)
            && all_pairs(&objects, |offset| {
                horizontal(offset) >= OBJECT_SEPARATION_M.max(diagonal_m(self.object_half_m))
            })
            && all_pairs(&goals, |offset| horizontal(offset) >= CLEARANCE_M)
            && all_pairs(&hands, |offset| horizontal(offset) >= HAND_SEPARATION_M)
            && hands.iter().enumerate().all(|(arm, hand)| {
                let is_own = |idx| idx == arm && self.grasped;
                let is_clear = |object: &Vector| self.is_clear(*hand, *object);
                objects.iter().enumerate().all(|(idx, object)| is_own(idx) || is_clear(object))
            })
            && self.has_order(&ways)
    }

    fn is_clear(&self, hand: Vector, object: Vector) -> bool {
        let gripper = self.parameters.gripper;
        let pad = gripper.pad_half;
        let hand_m = hypotenuse(pad.x, self.empty_opening_m() + 2.0 * pad.y);
        let object_m = self.object_half_m * std::f32::consts::SQRT_2;
        hand.z >= CLEAR_HEIGHT_M || horizontal(hand - object) >= hand_m + object_m + FINGER_GAP_M
    }

    /// Returns true if two objects can be served in one order or the other.
    fn has_order(&self, ways: &[Way]) -> bool {
        match ways {
            [first, second] => self.is_free(first, second) || self.is_free(second, first),
            _ => true,
        }
    }

    /// Returns true if `first` can be served while the object of `second` is at its start, and `second` after it.
    ///
    /// Pushed objects move straight across the table. Grasped ones are lifted, so only the ends of their ways count. An
    /// arm that holds its object in the air stays there while the other one works.
    fn is_free(&self, first: &Way, second: &Way) -> bool {
        if !self.layout.task.grasps() {
            return distance_to_segment(second.from, first) >= CLEARANCE_M
                && distance_to_segment(first.to, second) >= CLEARANCE_M;
        }
        if first.to.z < self.object_half_m + HOLD_HEIGHT_M {
            return horizontal(second.from - first.to) >= CLEARANCE_M;
        }
        [second.from, second.to].into_iter().all(|point| {
            let offset = first.frame.rotate(point - first.to);
            horizontal(offset) >= HAND_SEPARATION_M
                && (offset.x >= 0.0 || offset.y.abs() >= PASSING_M)
        })
    }
}

/// Returns the horizontal distance of `point` from the straight line between the ends of `way`, metres.
fn distance_to_segment(point: Vector, way: &Way) -> f32 {
    let flat = |vector: Vector| vector.with_z(0.0);
    let along = flat(way.to - way.from);
    let offset = flat(point - way.from);
    let share = offset.dot(along) / along.length_squared().max(f32::MIN_POSITIVE);
    (offset - along * share.clamp(0.0, 1.0)).length()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_distance_to_a_way_is_the_one_to_its_nearest_point() {
        let frame = ArmFrame::new(ArmIndex(0), 1);
        let way = Way { from: Vector::ZERO, to: Vector::new(0.2, 0.0, 0.1), frame };
        let check = |x, y, expected: f32| {
            let distance_m = distance_to_segment(Vector::new(x, y, 0.3), &way);
            assert!((distance_m - expected).abs() < 1e-6, "({x}, {y}): {distance_m}");
        };
        check(0.1, 0.05, 0.05);
        check(-0.03, 0.04, 0.05);
        check(0.23, -0.04, 0.05);
    }
}
