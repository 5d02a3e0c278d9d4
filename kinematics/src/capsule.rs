//! Links as capsules, and the gaps between them.

use nalgebra::{Isometry3, Point3};

use crate::forward::ForwardKinematics;
use crate::model::{ArmModel, SelfPair};

/// The largest number of links of an arm.
const MAX_LINKS: usize = 8;

/// All points within a radius of a line segment, metres.
#[derive(Debug, Clone, Copy)]
struct Capsule {
    ends: [Point3<f64>; 2],
    radius_m: f64,
}

/// The capsules of an arm's links in one configuration, base first.
#[derive(Debug, Clone, Copy)]
pub(crate) struct LinkCapsules {
    capsules: [Capsule; MAX_LINKS],
    n: usize,
}

impl LinkCapsules {
    /// Places the links of `model` in the world. The gripper is wide open.
    pub(crate) fn new(
        model: &ArmModel,
        forward: &ForwardKinematics,
        world_from_base: &Isometry3<f64>,
    ) -> Self {
        let empty = Capsule { ends: [Point3::origin(); 2], radius_m: 0.0 };
        let mut capsules = [empty; MAX_LINKS];
        for (capsule, link) in capsules.iter_mut().zip(model.links) {
            let ends = [0, 1].map(|end: usize| world_from_base * forward.anchor_m(&link.ends[end]));
            *capsule = Capsule { ends, radius_m: link.radius_m };
        }
        Self { capsules, n: model.links.len() }
    }

    fn iter(&self) -> impl Iterator<Item = (usize, &Capsule)> {
        self.capsules[..self.n].iter().enumerate()
    }

    /// Returns the smallest gap between the table and any link but the base, metres, and the index of that link.
    pub(crate) fn table_gap_m(&self, table_z_m: f64) -> (f64, usize) {
        let low = |capsule: &Capsule| {
            capsule.ends[0].z.min(capsule.ends[1].z) - capsule.radius_m - table_z_m
        };
        let gaps = self.iter().skip(1).map(|(link, capsule)| (low(capsule), link));
        gaps.fold((f64::INFINITY, 0), |least, gap| if gap.0 < least.0 { gap } else { least })
    }

    /// Returns the smallest gap between links of two arms, metres (negative if they overlap), and the indices of these
    /// links. The gap between the two bases does not count: bases do not move.
    pub(crate) fn gap_m(&self, other: &Self) -> (f64, [usize; 2]) {
        let mut least = (f64::INFINITY, [0, 0]);
        for (link, capsule) in self.iter() {
            for (other_link, other_capsule) in other.iter() {
                let gap_m = if link == 0 && other_link == 0 {
                    f64::INFINITY
                } else {
                    capsule.gap_m(other_capsule, least.0)
                };
                if gap_m < least.0 {
                    least = (gap_m, [link, other_link]);
                }
            }
        }
        least
    }

    /// Returns the smallest gap between two links of this arm that can collide, metres (negative if they overlap), and
    /// the indices of these links. The gripper is open by `gripper_opening` (0 to 1).
    pub(crate) fn self_gap_m(&self, model: &ArmModel, gripper_opening: f64) -> (f64, [usize; 2]) {
        let mut least = (f64::INFINITY, [0, 0]);
        for pair in model.self_pairs {
            let gap_m = self.pair_gap_m(model, pair, gripper_opening, least.0);
            if gap_m < least.0 {
                least = (gap_m, pair.links);
            }
        }
        least
    }

    /// Returns the gap between the links of `pair`, metres, or infinity if a bound shows that it exceeds `least_m`.
    pub(crate) fn pair_gap_m(
        &self,
        model: &ArmModel,
        pair: &SelfPair,
        gripper_opening: f64,
        least_m: f64,
    ) -> f64 {
        let [first, second] = pair.links.map(|link| {
            let closed_share = model.links[link].closed_share;
            self.capsules[link].shortened(closed_share + gripper_opening * (1.0 - closed_share))
        });
        first.gap_m(&second, least_m - pair.allowance_m) + pair.allowance_m
    }
}

impl Capsule {
    /// Returns the capsule with `share` of its segment, about the middle.
    fn shortened(&self, share: f64) -> Self {
        let middle = nalgebra::center(&self.ends[0], &self.ends[1]);
        let ends = self.ends.map(|end| middle + share * (end - middle));
        Self { ends, radius_m: self.radius_m }
    }

    /// Returns the gap to another capsule, metres, or infinity if a bound shows that it exceeds `least_m`.
    fn gap_m(&self, other: &Self, least_m: f64) -> f64 {
        let half = |capsule: &Self| 0.5 * (capsule.ends[1] - capsule.ends[0]);
        let (along, other_along) = (half(self), half(other));
        let between = (self.ends[0] + along) - (other.ends[0] + other_along);
        let radii_m = self.radius_m + other.radius_m;
        let far_m = least_m + radii_m + along.norm() + other_along.norm();
        if far_m < 0.0 || between.norm_squared() > far_m * far_m {
            return f64::INFINITY;
        }
        segment_distance_m(self.ends, other.ends) - radii_m
    }
}

/// Returns the distance between two segments, metres (Ericson, Real-Time Collision Detection, section 5.1.9).
fn segment_distance_m(first: [Point3<f64>; 2], second: [Point3<f64>; 2]) -> f64 {
    const TINY: f64 = 1e-18;
    let (along_first, along_second) = (first[1] - first[0], second[1] - second[0]);
    let offset = first[0] - second[0];
    let (a, e) = (along_first.norm_squared(), along_second.norm_squared());
    let (b, c, f) =
        (along_first.dot(&along_second), along_first.dot(&offset), along_second.dot(&offset));
    let determinant = a * e - b * b;
    let s = if determinant > TINY { ((b * f - c * e) / determinant).clamp(0.0, 1.0) } else { 0.0 };
    let t = (b * s + f) / e.max(TINY);
    let [s, t] = if t < 0.0 {
        [(-c / a.max(TINY)).clamp(0.0, 1.0), 0.0]
    } else if t > 1.0 {
        [((b - c) / a.max(TINY)).clamp(0.0, 1.0), 1.0]
    } else {
        [s, t]
    };
    (offset + along_first * s - along_second * t).norm()
}

#[cfg(test)]
mod tests {
    use super::*;
    use tandem_core::rng::uniform;
    use tandem_core::{Stream, episode_rng};

    #[test]
    fn the_distance_of_segments_is_the_least_distance_of_their_points() {
        let mut rng = episode_rng(1, 0, Stream::Reset);
        let mut point = || Point3::from([0; 3].map(|_| f64::from(uniform(&mut rng, -1.0, 1.0))));
        for round in 0..200 {
            let first = [point(), point()];
            let mut second = [point(), point()];
            if round % 4 == 0 {
                second[1] = second[0] + 0.5 * (first[1] - first[0]);
            }
            let mut least_m = f64::INFINITY;
            for s in 0..=60 {
                for t in 0..=60 {
                    let at = |ends: [Point3<f64>; 2], n: i32| {
                        ends[0].lerp(&ends[1], f64::from(n) / 60.0)
                    };
                    least_m = least_m.min((at(first, s) - at(second, t)).norm());
                }
            }
            let distance_m = segment_distance_m(first, second);
            assert!((-1e-9..0.02).contains(&(least_m - distance_m)), "{least_m} {distance_m}");
        }
    }
}
