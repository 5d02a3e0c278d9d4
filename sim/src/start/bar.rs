//! Initial states of two arms and a bar.
//!
//! The bar lies on the table, or is held level above it by both hands. Its goal is a level pose above the table.

use rand_chacha::ChaCha8Rng;
use rapier3d::math::Vector;
use tandem_core::rng::{bernoulli, uniform};
use tandem_core::{ArmIndex, WorldSettings};

use crate::bar::{HANDLE_M, SECTION_HALF_M, handle};
use crate::frame::{ArmFrame, MAX_ARMS};
use crate::hand::THREE_FINGERS;
use crate::start::ArmStart;

/// Half extents of the area of the bar's centre along x and y, metres.
const AREA_M: [f32; 2] = [0.08, 0.10];
/// Largest angle between the bar and the line through both arms' bases, radians.
const YAW_RAD: f32 = 20.0 * std::f32::consts::PI / 180.0;
/// Heights of a goal, and of a bar that is held at the start, metres.
pub(super) const AIR_M: [f32; 2] = [0.10, 0.25];
/// Smallest distance between a handle and its goal, metres.
const GOAL_DISTANCE_M: f32 = 0.08;
/// Half extent along x and y of the area of the hands, arm frame, metres, and their heights.
const HAND_M: f32 = 0.02;
const HAND_HEIGHT_M: [f32; 2] = [0.10, 0.16];
/// Largest offset of a hand from the handle that it holds, along the bar and along z, metres.
const GRASPED_OFFSET_M: [f32; 2] = [0.004, 0.008];

/// A level pose of the bar.
#[derive(Clone, Copy)]
struct BarPose {
    /// World frame, metres.
    centre: Vector,
    /// Its axis, world frame; the vector has length 1.
    axis: Vector,
    yaw_rad: f32,
}

/// Draws the initial state of both arms. The object of an arm is its handle.
pub(super) fn sample(rng: &mut ChaCha8Rng, settings: WorldSettings) -> Vec<ArmStart> {
    let is_held = bernoulli(rng, settings.grasped_start_prob);
    loop {
        let heights_m = if is_held { AIR_M } else { [SECTION_HALF_M; 2] };
        let (start, goal) = (BarPose::draw(rng, heights_m), BarPose::draw(rng, AIR_M));
        let arms: Vec<ArmStart> = (0..MAX_ARMS)
            .map(|arm| arm_start(rng, ArmIndex(arm), (start, goal), is_held))
            .collect();
        if arms.iter().all(|arm| (arm.object - arm.goal).length() >= GOAL_DISTANCE_M) {
            return arms;
        }
    }
}

/// Returns the smallest box, arm frame, metres, that contains the goals of all episodes: the range along each axis.
pub(super) fn goal_area() -> [[f32; 2]; 3] {
    let frame = ArmFrame::new(ArmIndex(0), MAX_ARMS);
    let (sin, cos) = libm::sincosf(YAW_RAD);
    let nearest = frame.arm_from_world(Vector::new(-AREA_M[0] - HANDLE_M, 0.0, 0.0));
    let furthest = frame.arm_from_world(Vector::new(AREA_M[0] - HANDLE_M * cos, 0.0, 0.0));
    let y_m = AREA_M[1] + HANDLE_M * sin;
    [[nearest.x, furthest.x], [-y_m, y_m], AIR_M]
}

fn arm_start(
    rng: &mut ChaCha8Rng,
    arm: ArmIndex,
    (start, goal): (BarPose, BarPose),
    is_held: bool,
) -> ArmStart {
    let frame = ArmFrame::new(arm, MAX_ARMS);
    let handle_of = |pose: BarPose| frame.arm_from_world(pose.handle(arm));
    let object = handle_of(start);
    let (end_effector, opening_m) = if is_held {
        let [along_m, up_m] = GRASPED_OFFSET_M;
        let along = frame.rotate(start.axis) * uniform(rng, -along_m, along_m);
        let up = Vector::Z * uniform(rng, -up_m, up_m);
        (object + along + up, start.opening_m())
    } else {
        let (x, y) = (uniform(rng, -HAND_M, HAND_M), uniform(rng, -HAND_M, HAND_M));
        let z = uniform(rng, HAND_HEIGHT_M[0], HAND_HEIGHT_M[1]);
        (Vector::new(x, y, z), THREE_FINGERS.max_opening_m)
    };
    let object_yaw_rad = start.yaw_rad;
    let goal = handle_of(goal);
    ArmStart { end_effector, opening_m, object, object_yaw_rad, holds_object: is_held, goal }
}

impl BarPose {
    fn draw(rng: &mut ChaCha8Rng, [low_m, high_m]: [f32; 2]) -> Self {
        let (x, y) = (uniform(rng, -AREA_M[0], AREA_M[0]), uniform(rng, -AREA_M[1], AREA_M[1]));
        let z = uniform(rng, low_m, high_m);
        let yaw_rad = uniform(rng, -YAW_RAD, YAW_RAD);
        let (sin, cos) = libm::sincosf(yaw_rad);
        Self { centre: Vector::new(x, y, z), axis: Vector::new(cos, sin, 0.0), yaw_rad }
    }

    /// Returns `arm`'s handle, world frame, metres.
    fn handle(self, arm: ArmIndex) -> Vector {
        self.centre + self.axis * handle(arm).x
    }

    /// Returns the opening of each side of a gripper at which its outer pads touch a handle, metres. Hands do not turn
    /// with the bar.
    fn opening_m(self) -> f32 {
        let [cos, sin] = [self.axis.x, self.axis.y.abs()];
        (SECTION_HALF_M + THREE_FINGERS.reach_m() * sin) / cos
    }
}
