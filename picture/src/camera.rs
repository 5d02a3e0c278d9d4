//! Projection of the world onto the picture.

use glam::DVec3;
use tandem_core::scene::{ArmScene, Point, Scene};

/// Azimuth of the view, degrees: 0 looks along +y, from the long side of the table.
const AZIMUTH_DEG: f64 = -24.0;
/// Elevation of the camera above the horizontal, degrees.
const ELEVATION_DEG: f64 = 30.0;
/// Distance of the camera from the centre of the scene, metres.
const DISTANCE_M: f64 = 2.6;
/// Share of the width or height of the picture that the arms and their workspaces fill.
const FILLED_SHARE: f64 = 0.95;
/// Height above the base of an arm that the picture includes, metres.
const ARM_HEIGHT_M: f64 = 0.70;
/// Depth and half width of an arm's workspace that the picture includes, metres.
const REACH_M: f64 = 0.62;
const HALF_WORKSPACE_M: f64 = 0.34;
/// Margin beside a base, metres.
const BASE_MARGIN_M: f64 = 0.14;
/// Smallest distance from the camera, metres.
const NEAREST_M: f64 = 0.1;

/// The positions of points of the world in the picture of a scene, which [`render`](crate::render) draws.
pub struct View(Camera);

impl View {
    /// Returns the view of a picture of this size, pixels. It depends on the arms' bases only.
    #[must_use]
    pub fn of(scene: &Scene, width: usize, height: usize) -> Self {
        Self(Camera::fitted(&scene.arms, table_z_m(scene), width, height))
    }

    /// Returns the place of `point` (world frame, metres) in the picture, pixels from the upper left corner.
    #[must_use]
    pub fn project(&self, point: Point) -> [f64; 2] {
        self.0.project(DVec3::from(point.map(f64::from)))
    }

    /// Returns the distance of `point` (world frame, metres) from the camera along the direction of the view, metres.
    /// Points with larger depths are behind.
    #[must_use]
    pub fn depth_m(&self, point: Point) -> f64 {
        (DVec3::from(point.map(f64::from)) - self.0.eye).dot(self.0.forward)
    }

    /// Returns the number of pixels of a metre across the view at `point`, world frame, metres.
    #[must_use]
    pub fn pixels_per_m(&self, point: Point) -> f64 {
        self.0.focal_px / self.depth_m(point).max(NEAREST_M)
    }

    /// Returns the position of the camera, world frame, metres.
    #[must_use]
    pub fn eye(&self) -> [f64; 3] {
        self.0.eye.to_array()
    }

    /// Returns the point at height `z_m` (world frame, metres) that is drawn at this place of the picture, pixels;
    /// `None` if the place is above the horizon.
    #[must_use]
    #[expect(clippy::cast_possible_truncation, reason = "metres")]
    pub fn at_height(&self, [x, y]: [f64; 2], z_m: f32) -> Option<Point> {
        let (origin, direction) = self.0.ray(x, y);
        let distance_m = (f64::from(z_m) - origin.z) / direction.z;
        let point = origin + distance_m * direction;
        let is_ahead = distance_m.is_finite() && distance_m > 0.0;
        is_ahead.then_some([point.x as f32, point.y as f32, z_m])
    }
}

/// Returns the height of the table's top, metres.
pub(crate) fn table_z_m(scene: &Scene) -> f64 {
    f64::from(scene.table.centre[2] + scene.table.half_extents_m[2])
}

/// A perspective camera.
pub(crate) struct Camera {
    eye: DVec3,
    right: DVec3,
    up: DVec3,
    forward: DVec3,
    focal_px: f64,
    centre_px: [f64; 2],
}

/// A part of the picture, pixels from the upper left corner.
pub(crate) struct Rectangle {
    pub(crate) low: [f64; 2],
    pub(crate) high: [f64; 2],
}

impl Rectangle {
    pub(crate) fn contains(&self, x: f64, y: f64) -> bool {
        (self.low[0]..=self.high[0]).contains(&x) && (self.low[1]..=self.high[1]).contains(&y)
    }
}

impl Camera {
    /// Creates a camera that shows `arms` and their workspaces as large as possible. The view does not depend on the
    /// arms' joints, so that all pictures of a task have the same.
    #[expect(clippy::cast_precision_loss, reason = "pixels of a picture that fits into memory")]
    pub(crate) fn fitted(arms: &[ArmScene], table_z_m: f64, width: usize, height: usize) -> Self {
        let points: Vec<DVec3> =
            arms.iter().flat_map(|arm| points_of(arm, table_z_m)).chain([DVec3::ZERO]).collect();
        let target = points.iter().sum::<DVec3>() / points.len() as f64;
        let mut camera = Self::new(target);
        let projected: Vec<[f64; 2]> = points.iter().map(|point| camera.project(*point)).collect();
        let range = |axis: usize| {
            projected.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), at| {
                (low.min(at[axis]), high.max(at[axis]))
            })
        };
        let ((left, right), (top, bottom)) = (range(0), range(1));
        let (width, height) = (width as f64, height as f64);
        let zoom = FILLED_SHARE * (width / (right - left)).min(height / (bottom - top));
        camera.focal_px = zoom;
        camera.centre_px =
            [0.5 * (width - zoom * (left + right)), 0.5 * (height - zoom * (top + bottom))];
        camera
    }

    /// Creates a camera with focal length 1 that looks at `target`.
    fn new(target: DVec3) -> Self {
        let (azimuth, elevation) = (AZIMUTH_DEG.to_radians(), ELEVATION_DEG.to_radians());
        let forward = DVec3::new(
            -azimuth.sin() * elevation.cos(),
            azimuth.cos() * elevation.cos(),
            -elevation.sin(),
        );
        let right = DVec3::new(azimuth.cos(), azimuth.sin(), 0.0);
        Self {
            eye: target - DISTANCE_M * forward,
            right,
            up: right.cross(forward),
            forward,
            focal_px: 1.0,
            centre_px: [0.0; 2],
        }
    }

    fn project(&self, point: DVec3) -> [f64; 2] {
        let offset = point - self.eye;
        let scale = self.focal_px / offset.dot(self.forward).max(NEAREST_M);
        [
            self.centre_px[0] + scale * offset.dot(self.right),
            self.centre_px[1] - scale * offset.dot(self.up),
        ]
    }

    /// Returns the ray through a place in the picture: its origin and its direction, a unit vector.
    pub(crate) fn ray(&self, x: f64, y: f64) -> (DVec3, DVec3) {
        let (right, up) = (x - self.centre_px[0], self.centre_px[1] - y);
        let direction = self.focal_px * self.forward + right * self.right + up * self.up;
        (self.eye, direction.normalize())
    }

    /// Returns a part of the picture that contains all points within `radius_m` of a segment.
    pub(crate) fn bounds(&self, ends: [DVec3; 2], radius_m: f64) -> Rectangle {
        let [one, other] = ends.map(|end| self.bounds_of_sphere(end, radius_m));
        Rectangle {
            low: [0, 1].map(|axis| one.low[axis].min(other.low[axis])),
            high: [0, 1].map(|axis| one.high[axis].max(other.high[axis])),
        }
    }

    /// Returns a part of the picture that contains all of a sphere.
    fn bounds_of_sphere(&self, centre: DVec3, radius_m: f64) -> Rectangle {
        let nearest_m = (centre - self.eye).dot(self.forward) - radius_m;
        if nearest_m < NEAREST_M {
            return Rectangle { low: [f64::NEG_INFINITY; 2], high: [f64::INFINITY; 2] };
        }
        // A sphere beside the view's axis is drawn as an ellipse, longer than wide by less than this.
        let radius_px = 1.2 * radius_m * self.focal_px / nearest_m;
        let at = self.project(centre);
        Rectangle { low: at.map(|x| x - radius_px), high: at.map(|x| x + radius_px) }
    }
}

fn points_of(arm: &ArmScene, table_z_m: f64) -> [DVec3; 5] {
    let base = DVec3::from(arm.base.map(f64::from));
    let ahead_m = if base.x < 0.0 { REACH_M } else { -REACH_M };
    let beside = |x_m: f64, side_m: f64| DVec3::new(base.x + x_m, base.y + side_m, table_z_m);
    [
        base + ARM_HEIGHT_M * DVec3::Z,
        beside(0.0, -BASE_MARGIN_M),
        beside(0.0, BASE_MARGIN_M),
        beside(ahead_m, -HALF_WORKSPACE_M),
        beside(ahead_m, HALF_WORKSPACE_M),
    ]
}

#[cfg(test)]
mod tests {
    use tandem_core::scene::Cuboid;

    use super::*;

    #[test]
    fn a_place_in_the_picture_is_that_of_its_point() {
        let arm = |x: f32| ArmScene {
            base: [x, 0.0, 0.0],
            joint_angles_rad: [0.0; 6],
            joint_points: Vec::new(),
            links: Vec::new(),
            hand: Vec::new(),
            end_effector: [0.0; 3],
        };
        let table = Cuboid {
            centre: [0.0, 0.0, -0.1],
            orientation: [0.0, 0.0, 0.0, 1.0],
            half_extents_m: [1.0, 1.0, 0.1],
        };
        let scene = Scene {
            time_s: 0.0,
            arms: vec![arm(-0.52), arm(0.52)],
            objects: Vec::new(),
            goals: Vec::new(),
            goal_tolerance_m: 0.05,
            table,
        };
        let view = View::of(&scene, 640, 400);
        for point in [[0.1, -0.05, 0.02], [-0.2, 0.12, 0.25]] {
            let place = view.project(point);
            assert!((0.0..640.0).contains(&place[0]) && (0.0..400.0).contains(&place[1]));
            let found = view.at_height(place, point[2]).expect("below the horizon");
            for (found, expected) in found.iter().zip(point) {
                assert!((found - expected).abs() < 1e-5, "{found} for {expected}");
            }
        }
        assert_eq!(view.at_height([320.0, -10_000.0], 0.0), None, "the sky");
        assert!(view.depth_m([0.0, 0.3, 0.0]) > view.depth_m([0.0, -0.3, 0.0]));
        assert!(view.pixels_per_m([0.0, 0.3, 0.0]) < view.pixels_per_m([0.0, -0.3, 0.0]));
    }
}
