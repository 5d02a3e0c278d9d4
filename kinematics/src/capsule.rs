//! Arms as capsules, and the gaps between them.

use glam::DVec3;

use crate::forward::ForwardKinematics;
use crate::model::ArmModel;
use crate::self_collision::SelfPair;
use crate::work_cell::PlacedArm;

/// Most links of an arm.
pub(crate) const MAX_LINKS: usize = 8;

/// A bar with round ends, world frame, metres.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Capsule {
    pub(crate) ends: [DVec3; 2],
    pub(crate) radius_m: f64,
}

/// An arm's links in one posture, base first.
#[derive(Debug, Clone, Copy)]
pub(crate) struct PosedLinks {
    capsules: [Capsule; MAX_LINKS],
    n: usize,
}

impl PosedLinks {
    /// The links in the world, the gripper wide open.
    pub(crate) fn of(arm: &PlacedArm, posture: &ForwardKinematics) -> Self {
        let axes = arm.axes();
        Self::placed(arm.model, posture, |in_base| arm.base_in_world_m + axes * in_base)
    }

    /// The links in the arm's base frame, the gripper wide open.
    pub(crate) fn in_base(model: &ArmModel, posture: &ForwardKinematics) -> Self {
        Self::placed(model, posture, |in_base| in_base)
    }

    fn placed(
        model: &ArmModel,
        posture: &ForwardKinematics,
        place: impl Fn(DVec3) -> DVec3,
    ) -> Self {
        let nowhere = Capsule { ends: [DVec3::ZERO; 2], radius_m: 0.0 };
        let mut capsules = [nowhere; MAX_LINKS];
        for (capsule, link) in capsules.iter_mut().zip(model.links) {
            let ends = [0, 1].map(|end: usize| place(posture.anchor(&link.ends[end])));
            *capsule = Capsule { ends, radius_m: link.radius_m };
        }
        Self { capsules, n: model.links.len() }
    }

    fn iter(&self) -> impl Iterator<Item = (usize, &Capsule)> {
        self.capsules[..self.n].iter().enumerate()
    }

    /// The smallest gap between any part but the base and the table, metres, and that part.
    pub(crate) fn table_gap_m(&self, table_z_m: f64) -> (f64, usize) {
        let low = |capsule: &Capsule| {
            capsule.ends[0].z.min(capsule.ends[1].z) - capsule.radius_m - table_z_m
        };
        let gaps = self.iter().skip(1).map(|(link, capsule)| (low(capsule), link));
        gaps.fold((f64::INFINITY, 0), |least, gap| if gap.0 < least.0 { gap } else { least })
    }

    /// The smallest gap between the parts of two arms, metres (negative when they overlap), and these parts.
    pub(crate) fn gap_m(&self, other: &Self) -> (f64, [usize; 2]) {
        let mut least = (f64::INFINITY, [0, 0]);
        for (link, capsule) in self.iter() {
            for (other_link, other_capsule) in other.iter() {
                // Two bases do not move.
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

    /// The smallest gap between two parts of this arm that can meet, metres (negative when they overlap), and these parts.
    /// The arm is `model`, its gripper open by `opening` (0 to 1).
    pub(crate) fn self_gap_m(&self, model: &ArmModel, opening: f64) -> (f64, [usize; 2]) {
        let mut least = (f64::INFINITY, [0, 0]);
        for pair in model.self_pairs {
            let gap_m = self.pair_gap_m(model, pair, opening, least.0);
            if gap_m < least.0 {
                least = (gap_m, pair.links);
            }
        }
        least
    }

    /// The gap between the parts of `pair`, metres; some larger number than `least_m` when that is quickly seen.
    pub(crate) fn pair_gap_m(
        &self,
        model: &ArmModel,
        pair: &SelfPair,
        opening: f64,
        least_m: f64,
    ) -> f64 {
        let [first, second] = pair.links.map(|link| {
            let shut_share = model.links[link].shut_share;
            self.capsules[link].shortened(shut_share + opening * (1.0 - shut_share))
        });
        first.gap_m(&second, least_m - pair.allowance_m) + pair.allowance_m
    }
}

impl Capsule {
    /// What is left of it about its middle.
    fn shortened(&self, share: f64) -> Self {
        let middle = 0.5 * (self.ends[0] + self.ends[1]);
        let ends = self.ends.map(|end| middle + share * (end - middle));
        Self { ends, radius_m: self.radius_m }
    }

    /// The gap to another capsule, metres; some larger number than `least_m` when that is quickly seen.
    fn gap_m(&self, other: &Self, least_m: f64) -> f64 {
        let half = |capsule: &Self| 0.5 * (capsule.ends[1] - capsule.ends[0]);
        let (along, other_along) = (half(self), half(other));
        let between = (self.ends[0] + along) - (other.ends[0] + other_along);
        let radii_m = self.radius_m + other.radius_m;
        let far_m = least_m + radii_m + along.length() + other_along.length();
        if far_m < 0.0 || between.length_squared() > far_m * far_m {
            return f64::INFINITY;
        }
        segment_distance_m(self.ends, other.ends) - radii_m
    }
}

/// The distance of two segments, metres.
fn segment_distance_m(first: [DVec3; 2], second: [DVec3; 2]) -> f64 {
    const TINY: f64 = 1e-18;
    let (along_first, along_second) = (first[1] - first[0], second[1] - second[0]);
    let offset = first[0] - second[0];
    let (a, e) = (along_first.length_squared(), along_second.length_squared());
    let (b, c, f) =
        (along_first.dot(along_second), along_first.dot(offset), along_second.dot(offset));
    let crossing = a * e - b * b;
    let s = if crossing > TINY { ((b * f - c * e) / crossing).clamp(0.0, 1.0) } else { 0.0 };
    let t = (b * s + f) / e.max(TINY);
    let [s, t] = if t < 0.0 {
        [(-c / a.max(TINY)).clamp(0.0, 1.0), 0.0]
    } else if t > 1.0 {
        [((b - c) / a.max(TINY)).clamp(0.0, 1.0), 1.0]
    } else {
        [s, t]
    };
    (offset + along_first * s - along_second * t).length()
}

#[cfg(test)]
mod tests {
    use super::*;
    use tandem_core::rng::uniform;
    use tandem_core::{Stream, episode_rng};

    #[test]
    fn the_distance_of_segments_is_the_least_between_their_points() {
        let mut rng = episode_rng(1, 0, Stream::Reset);
        let mut point =
            || DVec3::from_array([0; 3].map(|_| f64::from(uniform(&mut rng, -1.0, 1.0))));
        for round in 0..200 {
            let first = [point(), point()];
            let mut second = [point(), point()];
            if round % 4 == 0 {
                second[1] = second[0] + 0.5 * (first[1] - first[0]);
            }
            let mut least_m = f64::INFINITY;
            for s in 0..=60 {
                for t in 0..=60 {
                    let at = |ends: [DVec3; 2], n: i32| ends[0].lerp(ends[1], f64::from(n) / 60.0);
                    least_m = least_m.min((at(first, s) - at(second, t)).length());
                }
            }
            let distance_m = segment_distance_m(first, second);
            assert!((-1e-9..0.02).contains(&(least_m - distance_m)), "{least_m} {distance_m}");
        }
    }
}
