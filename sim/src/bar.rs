//! The bar that two arms carry: one body with a handle at each end and a plate in the middle.
//!
//! Each arm grasps its own handle. The plate is wider than an open gripper, so an arm cannot grasp the bar in the middle,
//! and the bar is too heavy for one hand to hold level at a handle.
//!
//! The half of the bar on the side of an arm belongs to that arm: it stands on the arm's own table. Two arms that
//! exchange their places, with the world turned by 180°, therefore meet the same bar.

use rapier3d::dynamics::{CoefficientCombineRule, RigidBodyBuilder, RigidBodyHandle};
use rapier3d::geometry::ColliderBuilder;
use rapier3d::math::Vector;
use tandem_core::ArmIndex;

use crate::frame::MAX_ARMS;
use crate::physics::{Part, Physics, collides};

/// Distance of each handle from the bar's centre, metres.
pub(crate) const HANDLE_M: f32 = 0.16;
/// Half the edge of the square cross-section that the hands grasp, metres.
pub(crate) const SECTION_HALF_M: f32 = 0.0225;
/// Half the length of the bar, metres.
pub(crate) const HALF_LENGTH_M: f32 = 0.20;
/// Half the length, width and height of the plate, metres.
pub(crate) const PLATE_HALF_M: Vector = Vector::new(0.08, 0.05, 0.01);
/// Mass of the bar, kilograms. Its density is uniform.
const MASS_KG: f32 = 0.5;

/// Returns 1 or −1, the side of the bar's centre along its axis on which `arm` has its handle.
const fn side(arm: ArmIndex) -> f32 {
    if arm.0 == 0 { -1.0 } else { 1.0 }
}

/// Returns `arm`'s handle relative to the bar's centre, in the bar's frame, metres.
pub(crate) const fn handle(arm: ArmIndex) -> Vector {
    Vector::new(side(arm) * HANDLE_M, 0.0, 0.0)
}

/// Adds a bar that has not been placed yet.
pub(crate) fn build(physics: &mut Physics, friction: f32) -> RigidBodyHandle {
    let body = physics.bodies.insert(RigidBodyBuilder::dynamic().can_sleep(false));
    let section_half =
        Vector::new(0.5 * (HALF_LENGTH_M - PLATE_HALF_M.x), SECTION_HALF_M, SECTION_HALF_M);
    let plate_half = Vector::new(0.5 * PLATE_HALF_M.x, PLATE_HALF_M.y, PLATE_HALF_M.z);
    let parts = [(section_half, HALF_LENGTH_M - section_half.x), (plate_half, plate_half.x)];
    let volume = |half: Vector| half.x * half.y * half.z;
    let volume_of_half: f32 = parts.iter().map(|(half, _)| volume(*half)).sum();
    for arm in (0..MAX_ARMS).map(ArmIndex) {
        for (half, from_centre_m) in parts {
            let part = ColliderBuilder::cuboid(half.x, half.y, half.z)
                .translation(Vector::new(side(arm) * from_centre_m, 0.0, 0.0))
                .mass(0.5 * MASS_KG * volume(half) / volume_of_half)
                .friction(friction)
                .friction_combine_rule(CoefficientCombineRule::Max)
                .collision_groups(collides(Part::Object, arm));
            physics.colliders.insert_with_parent(part, body, &mut physics.bodies);
        }
    }
    body
}
