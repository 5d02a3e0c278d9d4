//! Initial states: positions of hands and objects, and goals.

use rand_chacha::ChaCha8Rng;
use rapier3d::math::Vector;
use tandem_core::rng::{bernoulli, uniform};
use tandem_core::{ArmIndex, Layout, World, WorldSettings};

use crate::frame::ArmFrame;
use crate::parameters::WorldParameters;

mod bar;
mod shared;

/// Half extent along x of the area of objects and goals, arm frame, metres.
const AREA_X_M: f32 = 0.12;
/// Half extent along y of this area for one arm and for two, metres.
const AREA_Y_M: [f32; 2] = [0.15, 0.12];
/// Smallest horizontal distance between an object and a hand above the centre, metres.
const HAND_CLEARANCE_M: f32 = 0.10;
/// Smallest distance between an object and its goal, metres.
const GOAL_DISTANCE_M: f32 = 0.05;
/// Smallest distance between two objects, and between two goals, metres.
const SEPARATION_M: f32 = 0.07;
/// Smallest horizontal distance between two hands, metres.
const HAND_SEPARATION_M: f32 = 0.17;
/// Probability that a pick-and-place goal is above the table.
const AIR_GOAL_PROB: f32 = 0.5;
/// Largest height of such a goal above the table, metres.
const AIR_GOAL_HIGH_M: f32 = 0.25;
/// Largest height of the end effector in a grasped start, metres.
const GRASPED_HIGH_M: f32 = 0.30;
/// Largest offset of a grasped object from the centre of the pads along x and z, metres.
const GRASPED_OFFSET_M: [f32; 2] = [0.005, 0.008];

/// The initial state of one arm, arm frame, metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct ArmStart {
    pub(crate) end_effector: Vector,
    pub(crate) opening_m: f32,
    pub(crate) object: Vector,
    /// Rotation of the object about the vertical axis, radians.
    pub(crate) object_yaw_rad: f32,
    pub(crate) holds_object: bool,
    pub(crate) goal: Vector,
}

/// The initial position of the hands.
#[derive(Clone, Copy, PartialEq)]
enum HandStart {
    /// Above the centre of the workspace, as in all evaluation episodes.
    Centred,
    /// At an object, which is grasped.
    Grasping,
}

/// Returns the smallest box, arm frame, metres, that contains the goals of all episodes with objects of half edge
/// `object_half_m`: the range along each axis.
pub(crate) fn goal_area(layout: Layout, object_half_m: f32) -> [[f32; 2]; 3] {
    if layout.task.shares_object() {
        return bar::goal_area();
    }
    let (x_m, y_m, air_m) = match layout.task.world() {
        World::Classic | World::Slow => {
            ([-AREA_X_M, AREA_X_M], AREA_Y_M[usize::from(layout.n_arms > 1)], AIR_GOAL_HIGH_M)
        }
        World::Shared => (shared::AREA_X_M, shared::AREA_Y_M, shared::AIR_GOAL_HIGH_M),
    };
    let high_m = if layout.task.grasps() { object_half_m + air_m } else { object_half_m };
    [x_m, [-y_m, y_m], [object_half_m, high_m]]
}

/// Draws the initial state of every arm. Objects, goals and hands are apart from each other, and no goal is achieved.
pub(crate) fn sample_starts(
    rng: &mut ChaCha8Rng,
    layout: Layout,
    object_half_m: f32,
    settings: WorldSettings,
) -> Vec<ArmStart> {
    if layout.task.shares_object() {
        return bar::sample(rng, settings);
    }
    match layout.task.world() {
        World::Classic | World::Slow => sample_classic(rng, layout, object_half_m, settings),
        World::Shared => shared::sample(rng, layout, object_half_m, settings),
    }
}

fn sample_classic(
    rng: &mut ChaCha8Rng,
    layout: Layout,
    object_half_m: f32,
    settings: WorldSettings,
) -> Vec<ArmStart> {
    let parameters = WorldParameters::of(World::Classic);
    let grasped = bernoulli(rng, settings.grasped_start_prob);
    // Unused. It keeps the later draws at their places in the random stream, so that seeds keep their starts.
    let _: bool = bernoulli(rng, 0.0);
    let can_hold = layout.task.grasps() && object_half_m < parameters.gripper.max_opening_m;
    let hand_start = if grasped && can_hold { HandStart::Grasping } else { HandStart::Centred };
    let sampler = StartSampler { layout, object_half_m, parameters };
    loop {
        let arms: Vec<ArmStart> =
            layout.arms().map(|_| sampler.arm_start(rng, hand_start)).collect();
        if sampler.is_valid(&arms, hand_start) {
            return arms;
        }
    }
}

/// The parameters of the distributions.
struct StartSampler {
    layout: Layout,
    object_half_m: f32,
    parameters: &'static WorldParameters,
}

impl StartSampler {
    fn arm_start(&self, rng: &mut ChaCha8Rng, hand_start: HandStart) -> ArmStart {
        let on_table = self.point_on_table(rng);
        let goal = self.goal(rng);
        let (end_effector, opening_m, object) = match hand_start {
            HandStart::Centred => (self.centred_hand(rng), self.empty_opening_m(), on_table),
            HandStart::Grasping => {
                let hand = self.grasping_hand(rng);
                (hand, self.object_half_m, self.grasped_object(rng, hand))
            }
        };
        let holds_object = hand_start == HandStart::Grasping;
        ArmStart { end_effector, opening_m, object, object_yaw_rad: 0.0, holds_object, goal }
    }

    fn point_on_table(&self, rng: &mut ChaCha8Rng) -> Vector {
        let area_y_m = self.area_y_m();
        Vector::new(
            uniform(rng, -AREA_X_M, AREA_X_M),
            uniform(rng, -area_y_m, area_y_m),
            self.object_half_m,
        )
    }

    fn goal(&self, rng: &mut ChaCha8Rng) -> Vector {
        let on_table = self.point_on_table(rng);
        if self.layout.task.grasps() && bernoulli(rng, AIR_GOAL_PROB) {
            on_table + Vector::Z * uniform(rng, 0.0, AIR_GOAL_HIGH_M)
        } else {
            on_table
        }
    }

    fn centred_hand(&self, rng: &mut ChaCha8Rng) -> Vector {
        let (x, y) = (uniform(rng, -0.02, 0.02), uniform(rng, -0.02, 0.02));
        let z = if self.layout.task.grasps() { uniform(rng, 0.10, 0.16) } else { 0.06 };
        Vector::new(x, y, z)
    }

    fn grasping_hand(&self, rng: &mut ChaCha8Rng) -> Vector {
        let area_y_m = self.area_y_m();
        let lowest_m =
            self.object_half_m.max(self.parameters.workspace_low.z) + GRASPED_OFFSET_M[1];
        Vector::new(
            uniform(rng, -AREA_X_M, AREA_X_M),
            uniform(rng, -area_y_m, area_y_m),
            uniform(rng, lowest_m, GRASPED_HIGH_M),
        )
    }

    fn grasped_object(&self, rng: &mut ChaCha8Rng, hand: Vector) -> Vector {
        let [offset_x_m, offset_z_m] = GRASPED_OFFSET_M;
        hand + Vector::new(
            uniform(rng, -offset_x_m, offset_x_m),
            0.0,
            uniform(rng, -offset_z_m, offset_z_m),
        )
    }

    fn area_y_m(&self) -> f32 {
        AREA_Y_M[usize::from(self.layout.n_arms > 1)]
    }

    /// Returns the opening of each side of an empty gripper, metres.
    fn empty_opening_m(&self) -> f32 {
        if self.layout.task.grasps() { self.parameters.gripper.max_opening_m } else { 0.0 }
    }

    fn is_valid(&self, arms: &[ArmStart], hand_start: HandStart) -> bool {
        let in_world = |arm: usize, point| {
            ArmFrame::new(ArmIndex(arm), self.layout.n_arms).world_from_arm(point)
        };
        let points = |part: fn(&ArmStart) -> Vector| -> Vec<Vector> {
            arms.iter().enumerate().map(|(arm, start)| in_world(arm, part(start))).collect()
        };
        let (hands, objects, goals) = (
            points(|start| start.end_effector),
            points(|start| start.object),
            points(|start| start.goal),
        );
        let clear_of = |hand: Vector, object: Vector| match hand_start {
            HandStart::Centred => horizontal(hand - object) >= HAND_CLEARANCE_M,
            HandStart::Grasping => true,
        };
        arms.iter().all(|start| (start.object - start.goal).length() >= GOAL_DISTANCE_M)
            && all_pairs(&objects, |offset| {
                offset.length() >= SEPARATION_M.max(diagonal_m(self.object_half_m))
            })
            && all_pairs(&goals, |offset| offset.length() >= SEPARATION_M)
            && all_pairs(&hands, |offset| horizontal(offset) >= HAND_SEPARATION_M)
            && hands.iter().all(|hand| objects.iter().all(|object| clear_of(*hand, *object)))
    }
}

/// Returns the diagonal of the base of a cube with half edge `object_half_m`, metres. Two cubes whose centres are at least
/// this far apart do not overlap.
fn diagonal_m(object_half_m: f32) -> f32 {
    2.0 * std::f32::consts::SQRT_2 * object_half_m
}

fn horizontal(offset: Vector) -> f32 {
    Vector::new(offset.x, offset.y, 0.0).length()
}

/// Returns `true` if every two of `points` are far enough from each other.
fn all_pairs(points: &[Vector], far_enough: impl Fn(Vector) -> bool) -> bool {
    points
        .iter()
        .enumerate()
        .all(|(idx, point)| points[..idx].iter().all(|other| far_enough(*point - *other)))
}
