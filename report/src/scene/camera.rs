//! Projection of points of the world onto the picture.

use super::View;

/// A point or direction, metres, world frame.
pub(super) type Vec3 = [f64; 3];

/// Share of the width or height of the picture that the fitted points fill.
const FILLED_SHARE: f64 = 0.93;

/// A perspective camera.
pub(super) struct Camera {
    eye: Vec3,
    right: Vec3,
    up: Vec3,
    forward: Vec3,
    focal_px: f64,
    centre_px: [f64; 2],
}

/// A point in the picture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Projected {
    /// Pixels from the left.
    pub(super) x: f64,
    /// Pixels from the top.
    pub(super) y: f64,
    /// Distance from the camera along the view direction, metres.
    pub(super) depth_m: f64,
    /// Scale at that depth, pixels per metre.
    pub(super) scale: f64,
}

impl Camera {
    /// Creates a camera that shows all of `points` as large as possible.
    ///
    /// # Panics
    /// If there are no points.
    pub(super) fn fitted(view: &View, points: &[Vec3]) -> Self {
        assert!(!points.is_empty(), "a picture needs at least one point");
        let target = scaled(points.iter().copied().fold([0.0; 3], sum), 1.0 / points.len() as f64);
        let mut camera = Self::new(view, target);
        let projected: Vec<Projected> = points.iter().map(|point| camera.project(*point)).collect();
        let range = |along: fn(&Projected) -> f64| {
            let (low, high) = (f64::INFINITY, f64::NEG_INFINITY);
            projected
                .iter()
                .map(along)
                .fold((low, high), |(low, high), x| (low.min(x), high.max(x)))
        };
        let (left, right) = range(|at| at.x);
        let (top, bottom) = range(|at| at.y);
        let (width, height) = (f64::from(view.width), f64::from(view.height));
        let zoom = FILLED_SHARE * (width / (right - left)).min(height / (bottom - top));
        camera.focal_px *= zoom;
        let centred =
            |centre: f64, low: f64, high: f64| centre - zoom * (0.5 * (low + high) - centre);
        camera.centre_px = [centred(0.5 * width, left, right), centred(0.5 * height, top, bottom)];
        camera
    }

    fn new(view: &View, target: Vec3) -> Self {
        let (azimuth, elevation) = (view.azimuth_deg.to_radians(), view.elevation_deg.to_radians());
        let forward =
            [-azimuth.sin() * elevation.cos(), azimuth.cos() * elevation.cos(), -elevation.sin()];
        let right = [azimuth.cos(), azimuth.sin(), 0.0];
        let (width, height) = (f64::from(view.width), f64::from(view.height));
        Self {
            eye: sum(target, scaled(forward, -view.distance_m)),
            right,
            up: cross(right, forward),
            forward,
            focal_px: width,
            centre_px: [0.5 * width, 0.5 * height],
        }
    }

    /// Projects a point (world, metres).
    pub(super) fn project(&self, point: Vec3) -> Projected {
        let offset = difference(point, self.eye);
        let depth_m = dot(offset, self.forward).max(1e-3);
        let scale = self.focal_px / depth_m;
        Projected {
            x: self.centre_px[0] + scale * dot(offset, self.right),
            y: self.centre_px[1] - scale * dot(offset, self.up),
            depth_m,
            scale,
        }
    }

    /// Returns whether a face at `point` with outward `normal` is visible.
    pub(super) fn sees(&self, point: Vec3, normal: Vec3) -> bool {
        dot(difference(point, self.eye), normal) < 0.0
    }
}

pub(super) fn dot(a: Vec3, b: Vec3) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

pub(super) fn sum(a: Vec3, b: Vec3) -> Vec3 {
    std::array::from_fn(|i| a[i] + b[i])
}

pub(super) fn difference(a: Vec3, b: Vec3) -> Vec3 {
    std::array::from_fn(|i| a[i] - b[i])
}

pub(super) fn scaled(a: Vec3, factor: f64) -> Vec3 {
    a.map(|x| factor * x)
}

pub(super) fn cross(a: Vec3, b: Vec3) -> Vec3 {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// Rotates `vector` by the unit quaternion `xyzw`.
pub(super) fn rotated(xyzw: [f32; 4], vector: Vec3) -> Vec3 {
    let [x, y, z, w] = xyzw.map(f64::from);
    let axis = [x, y, z];
    let twice_cross = scaled(cross(axis, vector), 2.0);
    sum(sum(vector, scaled(twice_cross, w)), cross(axis, twice_cross))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_target_is_in_the_centre_and_up_is_up() {
        for azimuth_deg in [-70.0, 0.0, 35.0, 180.0] {
            let view = View { azimuth_deg, ..View::default() };
            let camera = Camera::new(&view, [0.0, 0.0, 0.2]);
            let middle = camera.project([0.0, 0.0, 0.2]);
            assert!((middle.x - 450.0).abs() < 1e-6 && (middle.y - 260.0).abs() < 1e-6);
            assert!((middle.depth_m - view.distance_m).abs() < 1e-9);
            let above = camera.project([0.0, 0.0, 0.3]);
            assert!(
                (above.x - middle.x).abs() < 1e-6
                    && above.y < middle.y
                    && above.depth_m < middle.depth_m
            );
        }
    }

    #[test]
    fn a_fitted_camera_shows_every_point_and_fills_the_picture() {
        let points = [
            [-0.7, -0.4, 0.0],
            [0.7, -0.4, 0.0],
            [0.7, 0.4, 0.0],
            [-0.7, 0.4, 0.0],
            [0.5, 0.0, 0.7],
        ];
        let camera = Camera::fitted(&View::default(), &points);
        let share = points.iter().map(|point| {
            let at = camera.project(*point);
            ((at.x - 450.0).abs() / 450.0).max((at.y - 260.0).abs() / 260.0)
        });
        assert!((share.fold(0.0, f64::max) - FILLED_SHARE).abs() < 1e-9);
    }

    #[test]
    fn from_the_front_x_points_right_and_y_away() {
        let camera = Camera::new(&View { azimuth_deg: 0.0, ..View::default() }, [0.0; 3]);
        let (middle, right, far) = (
            camera.project([0.0; 3]),
            camera.project([0.1, 0.0, 0.0]),
            camera.project([0.0, 0.1, 0.0]),
        );
        assert!(right.x > middle.x && (right.y - middle.y).abs() < 1e-6);
        assert!(far.depth_m > middle.depth_m && far.y < middle.y);
    }

    #[test]
    fn a_quarter_turn_about_z_rotates_x_to_y() {
        let half = std::f32::consts::FRAC_1_SQRT_2;
        let turned = rotated([0.0, 0.0, half, half], [1.0, 0.0, 0.0]);
        assert!(difference(turned, [0.0, 1.0, 0.0]).iter().all(|x| x.abs() < 1e-6), "{turned:?}");
    }
}
