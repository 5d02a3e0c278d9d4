//! The object that all arms share: from the training world to the table, and how hands that hold it move.

use glam::{DVec3, Quat, Vec3};
use tandem_core::scene::Cuboid;
use tandem_sim::description::{Geometry, WorldDescription};

use crate::simulated::{ObjectBox, SharedObject};

/// Returns the object of all arms in `world`, which scenes show as `shown`: first the box around the point of each arm,
/// world frame, metres.
pub(crate) fn shared_object(world: &WorldDescription, shown: &[Cuboid]) -> SharedObject {
    let points: Vec<Vec3> = world.arms.iter().map(|arm| arm.object_point_m.into()).collect();
    let body = world.arms.first().map(|arm| arm.object);
    let of_body = world.shapes.iter().filter(|shape| shape.body.is_some() && shape.body == body);
    let boxes = of_body.filter_map(|shape| match shape.geometry {
        Geometry::BoxHalfExtentsM(half_m) => {
            Some(ObjectBox { centre_m: shape.position_m, half_m, mass_kg: shape.mass_kg })
        }
        Geometry::CapsuleRadiusAndHalfLengthM(_) => None,
    });
    let rotation =
        shown.first().map_or(Quat::IDENTITY, |first| Quat::from_array(first.orientation));
    let position = match (shown.first(), points.first()) {
        (Some(first), Some(point)) => Vec3::from(first.centre) - rotation * *point,
        _ => Vec3::ZERO,
    };
    let in_body = |shown: &Cuboid| Cuboid {
        centre: (rotation.inverse() * (Vec3::from(shown.centre) - position)).to_array(),
        orientation: (rotation.inverse() * Quat::from_array(shown.orientation)).to_array(),
        half_extents_m: shown.half_extents_m,
    };
    let ahead = rotation * Vec3::X;
    SharedObject {
        boxes: boxes.collect(),
        shown: shown.iter().map(in_body).collect(),
        points_m: points.iter().map(Vec3::to_array).collect(),
        at_m: position.to_array(),
        yaw_rad: libm::atan2f(ahead.y, ahead.x),
    }
}

/// Returns `object` with the points of its arms at `points` (world frame, metres), as far as a rigid body that stays
/// level can have them there.
pub(crate) fn placed(object: SharedObject, points: &[DVec3]) -> SharedObject {
    let ([first, second], [from, to]) = (&object.points_m[..], points) else { return object };
    let in_body = Vec3::from(*second) - Vec3::from(*first);
    let (along, middle) = ((*to - *from).as_vec3(), from.midpoint(*to).as_vec3());
    let yaw_rad = libm::atan2f(along.y, along.x) - libm::atan2f(in_body.y, in_body.x);
    let middle_in_body = Vec3::from(*first).midpoint(Vec3::from(*second));
    let position = middle - rotation_about_z(yaw_rad) * middle_in_body;
    SharedObject { at_m: position.to_array(), yaw_rad, ..object }
}

fn rotation_about_z(yaw_rad: f32) -> Quat {
    let (sin, cos) = libm::sincosf(0.5 * yaw_rad);
    Quat::from_xyzw(0.0, 0.0, sin, cos)
}

/// Moves the points `to` (world frame, metres) of two hands that hold one rigid object as little as possible, so that
/// their distance is that of `from`. Each hand gives way by half of the difference along the line between them. Other
/// numbers of hands stay where they are.
///
/// In the training world palms that disagree give way before their pads slip; arms would pull.
pub(crate) fn keep_distance(from: &[DVec3], to: &mut [DVec3]) {
    let ([first, second], [to_first, to_second]) = (from, to) else { return };
    let middle = to_first.midpoint(*to_second);
    let Some(along) = (*to_second - *to_first).try_normalize() else { return };
    let half_m = 0.5 * first.distance(*second);
    (*to_first, *to_second) = (middle - along * half_m, middle + along * half_m);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hands_that_disagree_meet_in_the_middle_and_agreeing_hands_are_not_moved() {
        let from = [DVec3::new(-0.16, 0.0, 0.1), DVec3::new(0.16, 0.0, 0.1)];
        let mut apart = [DVec3::new(-0.20, 0.0, 0.12), DVec3::new(0.18, 0.0, 0.12)];
        keep_distance(&from, &mut apart);
        let expected = [DVec3::new(-0.17, 0.0, 0.12), DVec3::new(0.15, 0.0, 0.12)];
        assert!((0..2).all(|arm| apart[arm].distance(expected[arm]) < 1e-12), "{apart:?}");
        let moved = from.map(|point| point + DVec3::new(0.02, -0.03, 0.05));
        let mut together = moved;
        keep_distance(&from, &mut together);
        assert!((0..2).all(|arm| together[arm].distance(moved[arm]) < 1e-12), "{together:?}");
    }
}
