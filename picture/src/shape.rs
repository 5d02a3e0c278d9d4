//! Shapes and where rays meet them.

use glam::{DMat3, DQuat, DVec3};
use tandem_core::scene::{Capsule, Cuboid};

/// A solid, world frame, metres.
pub(crate) struct Shape {
    solid: Solid,
    /// Centre of the solid.
    pub(crate) centre: DVec3,
    /// Radius of a sphere around the centre that contains the solid.
    pub(crate) radius_m: f64,
}

enum Solid {
    /// A cylinder with hemispherical ends, or a sphere if both ends are the same point.
    Capsule { from: DVec3, to: DVec3, radius_m: f64 },
    /// A box. The columns of the matrix are its axes.
    Cuboid { world_from_box: DMat3, half_m: DVec3 },
}

/// The place where a ray enters a shape.
pub(crate) struct Hit {
    /// Distance from the ray's origin.
    pub(crate) distance_m: f64,
    /// Outward normal, a unit vector.
    pub(crate) normal: DVec3,
}

impl Shape {
    pub(crate) fn capsule(capsule: &Capsule) -> Self {
        let [from, to] = [capsule.from, capsule.to].map(|end| DVec3::from(end.map(f64::from)));
        let radius_m = f64::from(capsule.radius_m);
        Self {
            centre: from.midpoint(to),
            radius_m: 0.5 * from.distance(to) + radius_m,
            solid: Solid::Capsule { from, to, radius_m },
        }
    }

    pub(crate) fn sphere(centre: DVec3, radius_m: f64) -> Self {
        Self { solid: Solid::Capsule { from: centre, to: centre, radius_m }, centre, radius_m }
    }

    pub(crate) fn cuboid(cuboid: &Cuboid) -> Self {
        let orientation = DQuat::from_array(cuboid.orientation.map(f64::from)).normalize();
        let half_m = DVec3::from(cuboid.half_extents_m.map(f64::from));
        Self {
            centre: DVec3::from(cuboid.centre.map(f64::from)),
            radius_m: half_m.length(),
            solid: Solid::Cuboid { world_from_box: DMat3::from_quat(orientation), half_m },
        }
    }

    /// Returns the ends of a segment and a distance from it, metres, within which all of the solid is.
    pub(crate) fn extent(&self) -> ([DVec3; 2], f64) {
        match self.solid {
            Solid::Capsule { from, to, radius_m } => ([from, to], radius_m),
            Solid::Cuboid { .. } => ([self.centre; 2], self.radius_m),
        }
    }

    /// Returns where the ray from `origin` along the unit vector `direction` enters the shape. A ray that starts inside
    /// does not.
    #[inline]
    pub(crate) fn hit(&self, origin: DVec3, direction: DVec3) -> Option<Hit> {
        let offset = self.centre - origin;
        let along_m = offset.dot(direction);
        let beside_m2 = offset.length_squared() - along_m * along_m;
        if along_m < -self.radius_m || beside_m2 > self.radius_m * self.radius_m {
            return None;
        }
        match &self.solid {
            Solid::Capsule { from, to, radius_m } => {
                hit_capsule(origin, direction, *from, *to, *radius_m)
            }
            Solid::Cuboid { world_from_box, half_m } => {
                let box_from_world = world_from_box.transpose();
                let local =
                    hit_box(-(box_from_world * offset), box_from_world * direction, *half_m)?;
                Some(Hit { normal: *world_from_box * local.normal, ..local })
            }
        }
    }
}

fn hit_capsule(
    origin: DVec3,
    direction: DVec3,
    from: DVec3,
    to: DVec3,
    radius_m: f64,
) -> Option<Hit> {
    let (axis, offset) = (to - from, origin - from);
    let (axis_axis, axis_ray) = (axis.dot(axis), axis.dot(direction));
    let (axis_offset, ray_offset) = (axis.dot(offset), direction.dot(offset));
    let a = axis_axis - axis_ray * axis_ray;
    let b = axis_axis * ray_offset - axis_offset * axis_ray;
    let c = axis_axis * (offset.length_squared() - radius_m * radius_m) - axis_offset * axis_offset;
    let discriminant = b * b - a * c;
    if discriminant < 0.0 {
        return None;
    }
    let distance_m = if a > 0.0 { (-b - discriminant.sqrt()) / a } else { f64::NEG_INFINITY };
    let along = axis_offset + distance_m * axis_ray;
    if distance_m > 0.0 && along > 0.0 && along < axis_axis {
        let foot = from + axis * (along / axis_axis);
        let normal = (origin + distance_m * direction - foot) / radius_m;
        return Some(Hit { distance_m, normal });
    }
    let ends =
        [from, to].into_iter().filter_map(|end| hit_sphere(origin, direction, end, radius_m));
    ends.min_by(|a, b| a.distance_m.total_cmp(&b.distance_m))
}

fn hit_sphere(origin: DVec3, direction: DVec3, centre: DVec3, radius_m: f64) -> Option<Hit> {
    let offset = origin - centre;
    let b = direction.dot(offset);
    let discriminant = b * b - offset.length_squared() + radius_m * radius_m;
    let distance_m = -b - discriminant.max(0.0).sqrt();
    let normal = (offset + distance_m * direction) / radius_m;
    (discriminant >= 0.0 && distance_m > 0.0).then_some(Hit { distance_m, normal })
}

/// Returns where a ray enters a box at the origin whose edges are parallel to the axes.
fn hit_box(origin: DVec3, direction: DVec3, half_m: DVec3) -> Option<Hit> {
    let slopes = direction.recip();
    let (middle, half) = (-origin * slopes, half_m * slopes.abs());
    let (enter, leave) = (middle - half, middle + half);
    let (distance_m, leave_m) = (enter.max_element(), leave.min_element());
    if !(distance_m > 0.0 && distance_m <= leave_m) {
        return None;
    }
    let is_face = enter.cmpge(DVec3::splat(distance_m));
    let normal = DVec3::select(is_face, -direction.signum(), DVec3::ZERO).normalize();
    Some(Hit { distance_m, normal })
}
