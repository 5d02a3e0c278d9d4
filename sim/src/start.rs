//! Where an episode starts and where its objects shall go.

use rand_chacha::ChaCha8Rng;
use rapier3d::math::Vector;
use tandem_core::rng::{coin, uniform};
use tandem_core::{ArmIndex, Layout, Task, WorldSettings};

use crate::frame::{OwnFrame, WORKSPACE_LOW};
use crate::hand::MAX_OPENING_M;

/// Half the area of objects and goals along x, own frame, metres.
const AREA_X_M: f32 = 0.12;
/// The same along y, for one arm and for two.
const AREA_Y_M: [f32; 2] = [0.15, 0.12];
/// Least horizontal distance of an object from any hand that starts above the middle, metres.
const HAND_CLEARANCE_M: f32 = 0.10;
/// Least distance of an object from its goal, metres.
const GOAL_DISTANCE_M: f32 = 0.05;
/// Least distance of two objects, and of two goals, metres.
const APART_M: f32 = 0.07;
/// Least horizontal distance of two hands, metres.
const HANDS_APART_M: f32 = 0.17;
/// Share of pick-and-place goals that are above the table, and up to how far, metres.
const AIR_SHARE: f32 = 0.5;
const AIR_M: f32 = 0.25;
/// Highest end effector of a gripped start, metres.
const GRIPPED_HIGH_M: f32 = 0.30;
/// How far a gripped object may be off the pads' centre along x and z, metres.
const GRIPPED_OFF_M: [f32; 2] = [0.005, 0.008];

/// How one arm starts: own frame, metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct ArmStart {
    pub(crate) end_effector: Vector,
    pub(crate) opening_m: f32,
    pub(crate) object: Vector,
    pub(crate) goal: Vector,
}

/// How the hands of an episode start.
#[derive(Clone, Copy, PartialEq)]
enum Kind {
    /// Above the middle of the workspace: as evaluated.
    Middle,
    /// With the object held.
    Gripped,
}

/// Draws how every arm starts: objects, goals and hands apart from each other, nothing achieved yet.
pub(crate) fn draw(
    rng: &mut ChaCha8Rng,
    layout: Layout,
    object_half_m: f32,
    settings: WorldSettings,
) -> Vec<ArmStart> {
    let grasped = coin(rng, settings.grasped_start_prob);
    // An episode's later draws keep their place in the random stream: this one belonged to a removed kind of start.
    let _: bool = coin(rng, 0.0);
    let can_hold = layout.task == Task::PickAndPlace && object_half_m < MAX_OPENING_M;
    let kind = if grasped && can_hold { Kind::Gripped } else { Kind::Middle };
    let area = Area { layout, object_half_m };
    loop {
        let arms: Vec<ArmStart> = layout.arms().map(|_| area.arm_start(rng, kind)).collect();
        if area.is_free(&arms, kind) {
            return arms;
        }
    }
}

/// What the draws depend on.
struct Area {
    layout: Layout,
    object_half_m: f32,
}

impl Area {
    fn arm_start(&self, rng: &mut ChaCha8Rng, kind: Kind) -> ArmStart {
        let on_table = self.point_on_table(rng);
        let goal = self.goal(rng);
        let (end_effector, opening_m, object) = match kind {
            Kind::Middle => (self.hand_in_the_middle(rng), self.free_opening_m(), on_table),
            Kind::Gripped => {
                let hand = self.holding_hand(rng);
                (hand, self.object_half_m, self.held_object(rng, hand))
            }
        };
        ArmStart { end_effector, opening_m, object, goal }
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
        if self.layout.task == Task::PickAndPlace && coin(rng, AIR_SHARE) {
            on_table + Vector::Z * uniform(rng, 0.0, AIR_M)
        } else {
            on_table
        }
    }

    fn hand_in_the_middle(&self, rng: &mut ChaCha8Rng) -> Vector {
        let (x, y) = (uniform(rng, -0.02, 0.02), uniform(rng, -0.02, 0.02));
        let z = match self.layout.task {
            Task::Push => 0.06,
            Task::PickAndPlace => uniform(rng, 0.10, 0.16),
        };
        Vector::new(x, y, z)
    }

    fn holding_hand(&self, rng: &mut ChaCha8Rng) -> Vector {
        let area_y_m = self.area_y_m();
        let lowest_m = self.object_half_m.max(WORKSPACE_LOW.z) + GRIPPED_OFF_M[1];
        Vector::new(
            uniform(rng, -AREA_X_M, AREA_X_M),
            uniform(rng, -area_y_m, area_y_m),
            uniform(rng, lowest_m, GRIPPED_HIGH_M),
        )
    }

    fn held_object(&self, rng: &mut ChaCha8Rng, hand: Vector) -> Vector {
        let [off_x_m, off_z_m] = GRIPPED_OFF_M;
        hand + Vector::new(uniform(rng, -off_x_m, off_x_m), 0.0, uniform(rng, -off_z_m, off_z_m))
    }

    fn area_y_m(&self) -> f32 {
        AREA_Y_M[usize::from(self.layout.n_arms > 1)]
    }

    /// How far a hand that holds nothing is open.
    fn free_opening_m(&self) -> f32 {
        match self.layout.task {
            Task::Push => 0.0,
            Task::PickAndPlace => MAX_OPENING_M,
        }
    }

    fn is_free(&self, arms: &[ArmStart], kind: Kind) -> bool {
        let in_world = |arm: usize, point| {
            OwnFrame::of(ArmIndex(arm), self.layout.n_arms).world_from_own(point)
        };
        let points = |part: fn(&ArmStart) -> Vector| -> Vec<Vector> {
            arms.iter().enumerate().map(|(arm, start)| in_world(arm, part(start))).collect()
        };
        let (hands, objects, goals) = (
            points(|start| start.end_effector),
            points(|start| start.object),
            points(|start| start.goal),
        );
        let clear_of = |hand: Vector, object: Vector| match kind {
            Kind::Middle => horizontal(hand - object) >= HAND_CLEARANCE_M,
            Kind::Gripped => true,
        };
        arms.iter().all(|start| (start.object - start.goal).length() >= GOAL_DISTANCE_M)
            && apart(&objects, |offset| offset.length() >= APART_M)
            && apart(&goals, |offset| offset.length() >= APART_M)
            && apart(&hands, |offset| horizontal(offset) >= HANDS_APART_M)
            && hands.iter().all(|hand| objects.iter().all(|object| clear_of(*hand, *object)))
    }
}

fn horizontal(offset: Vector) -> f32 {
    Vector::new(offset.x, offset.y, 0.0).length()
}

/// Whether every two of `points` are far enough from each other.
fn apart(points: &[Vector], far_enough: impl Fn(Vector) -> bool) -> bool {
    points
        .iter()
        .enumerate()
        .all(|(idx, point)| points[..idx].iter().all(|other| far_enough(*point - *other)))
}
