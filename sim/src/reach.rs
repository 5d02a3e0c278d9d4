//! The positions that a Mico with four joints reaches with its gripper tilted by at most 45 degrees.
//!
//! The arm turns about the vertical axis of its base, so they are given by a range of radii for each height. The ranges
//! are interpolated linearly between heights. They stay a few millimetres within the true ones, which `tandem-trials`
//! tests with the arm's kinematics.

use rapier3d::math::Vector;
use serde::Serialize;
use tandem_core::World;

/// Radii about the vertical axis through an arm's base that the arm reaches at each height.
#[derive(Debug, PartialEq, Serialize)]
pub struct Reach {
    /// Position of the axis along x, arm frame, metres.
    axis_x_m: f32,
    rings: [Ring; 5],
}

/// Smallest and largest radius at a height of the end effector above the table, metres.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
struct Ring {
    height_m: f32,
    radii_m: [f32; 2],
}

impl Reach {
    /// The reach of a Mico whose base is placed as in the shared world's work cell.
    pub const MICO: Self = Self {
        axis_x_m: -World::Shared.mico_base_distance_m(),
        rings: [
            Ring { height_m: 0.031, radii_m: [0.160, 0.495] },
            Ring { height_m: 0.100, radii_m: [0.160, 0.495] },
            Ring { height_m: 0.200, radii_m: [0.182, 0.465] },
            Ring { height_m: 0.300, radii_m: [0.182, 0.375] },
            Ring { height_m: 0.330, radii_m: [0.182, 0.305] },
        ],
    };

    /// Returns the smallest and the largest radius from the base's axis at which the end effector can be `height_m`
    /// above the table, metres. Below 3.1 cm and above 33 cm they are those of the nearest one of these heights.
    #[must_use]
    pub fn radii_m(&self, height_m: f32) -> [f32; 2] {
        let [lowest, .., highest] = self.rings;
        if height_m <= lowest.height_m {
            return lowest.radii_m;
        }
        let between = self.rings.windows(2).find_map(|rings| {
            let (below, above) = (rings[0], rings[1]);
            let share = (height_m - below.height_m) / (above.height_m - below.height_m);
            let at =
                |end: usize| below.radii_m[end] + share * (above.radii_m[end] - below.radii_m[end]);
            (height_m <= above.height_m).then(|| [at(0), at(1)])
        });
        between.unwrap_or(highest.radii_m)
    }

    /// Returns the distance of a point (arm frame, metres) from the base's axis.
    #[must_use]
    pub fn radius_m(&self, [x, y, _]: [f32; 3]) -> f32 {
        let x_m = x - self.axis_x_m;
        (x_m * x_m + y * y).sqrt()
    }

    /// Returns the point of the base's axis at `height_m` metres, arm frame.
    #[must_use]
    pub fn axis(&self, height_m: f32) -> Vector {
        Vector::new(self.axis_x_m, 0.0, height_m)
    }

    /// Moves a point (arm frame, metres) along its radius, at its height, to the nearest one in reach.
    #[must_use]
    pub fn clamp(&self, point: Vector) -> Vector {
        let radius_m = self.radius_m(point.to_array());
        let [low_m, high_m] = self.radii_m(point.z);
        if (low_m..=high_m).contains(&radius_m) {
            return point;
        }
        let scale = radius_m.clamp(low_m, high_m) / radius_m.max(f32::MIN_POSITIVE);
        Vector::new(self.axis_x_m + (point.x - self.axis_x_m) * scale, point.y * scale, point.z)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn radii_are_interpolated_between_heights() {
        let check = |height_m, expected: [f32; 2]| {
            let radii_m = Reach::MICO.radii_m(height_m);
            let near = |end: usize| (radii_m[end] - expected[end]).abs() < 1e-6;
            assert!(near(0) && near(1), "{height_m} m: {radii_m:?}");
        };
        check(0.0, [0.160, 0.495]);
        check(0.15, [0.171, 0.480]);
        check(0.25, [0.182, 0.420]);
        check(0.33, [0.182, 0.305]);
        check(0.50, [0.182, 0.305]);
    }

    #[test]
    fn points_out_of_reach_move_along_their_radius() {
        let reach = Reach::MICO;
        let far = Vector::new(0.25, 0.20, 0.30);
        let nearest = reach.clamp(far);
        assert!((reach.radius_m(nearest.to_array()) - 0.375).abs() < 1e-6);
        let angle = |point: Vector| point.y / (point.x + World::Shared.mico_base_distance_m());
        assert!((angle(nearest) - angle(far)).abs() < 1e-6 && nearest.z == far.z);
        let inside = Vector::new(0.05, -0.1, 0.2);
        assert_eq!(reach.clamp(inside), inside);
    }
}
