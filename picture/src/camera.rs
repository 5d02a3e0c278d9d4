//! Projection of the world onto the picture.

use glam::DVec3;
use tandem_core::scene::ArmScene;

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
    low: [f64; 2],
    high: [f64; 2],
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

    /// Returns a part of the picture that contains all of a sphere.
    pub(crate) fn bounds(&self, centre: DVec3, radius_m: f64) -> Rectangle {
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
