//! Keeps the links of two arms apart by limiting how fast they may approach.
//!
//! The links are no rapier bodies: posed by inverse kinematics they would push with unlimited force. Instead each
//! arm's wanted velocity is limited, for every close pair of capsules, along the pair's normal: the approach may be at
//! most [`APPROACH_GAIN`] times the gap, and an overlap must be left. The limit acts through the palm's bounded servo.
//!
//! A pair that overlaps keeps the side from which it came: where two axes cross, the direction between their nearest
//! points turns over, and taken as it is it would pull the links through each other.

use rapier3d::math::{Matrix, Vector};

use crate::arm::Arm;
use crate::capsule::{N_CAPSULES, N_LINKS, PosedArm, nearest_shares};
use crate::physics::Physics;

/// Pairs of capsules of two arms of which at least one is a link: wrists, palms and fingers collide in rapier.
const N_PAIRS: usize = N_CAPSULES * N_CAPSULES - (N_CAPSULES - N_LINKS) * (N_CAPSULES - N_LINKS);

/// Largest approach speed of an arm per metre of gap, 1/s.
const APPROACH_GAIN: f32 = 20.0;
/// Largest speed at which an overlap is left, metres per second.
const SEPARATION_MPS: f32 = 0.4;
/// Gap above which a pair limits nothing, metres.
const LIMIT_WITHIN_M: f32 = 0.08;
/// Gap at the start of a control step above which a pair cannot come within [`LIMIT_WITHIN_M`] in that step, metres.
const WATCH_WITHIN_M: f32 = 0.24;
/// Distance of two axes below which their direction from each other says nothing, metres.
const CROSSING_M: f32 = 0.002;
/// Share of the palm's motion that a capsule's point is taken to follow at least, so that the palm need not race to
/// move what hardly follows it.
const LEAST_LEVERAGE: f32 = 0.3;
/// Half-planes that one velocity is projected onto, at most, before it is scaled back instead.
const MAX_PROJECTIONS: usize = 12;

/// One capsule of the first arm against one of the second.
#[derive(Clone, Copy)]
struct Pair {
    capsules: [usize; 2],
    /// Unit vector towards the first arm's capsule, as of when the pair was last looked at.
    normal: Option<Vector>,
    /// Whether the pair can come close in this control step.
    watched: bool,
}

/// How a pair stands in one physics step.
struct Nearness {
    gap_m: f32,
    /// Unit vector towards the first arm's capsule.
    normal: Vector,
    /// How the nearest point of each arm's capsule moves with its palm.
    motions: [Matrix; 2],
}

/// What an arm's velocity must satisfy: `direction · velocity >= least_mps`.
#[derive(Clone, Copy)]
struct Limit {
    direction: Vector,
    least_mps: f32,
}

/// An arm's limits in one physics step: the first `n` of `limits`.
struct Limits {
    limits: [Limit; N_PAIRS],
    n: usize,
}

/// The velocity damper between two arms.
#[derive(Clone)]
pub(crate) struct LinkGuard {
    arms: [PosedArm; 2],
    pairs: [Pair; N_PAIRS],
    smallest_gap_m: f32,
}

impl LinkGuard {
    /// A guard of `arms` as they stand now.
    pub(crate) fn new(arms: [&Arm; 2], physics: &Physics) -> Self {
        let mut guard = Self {
            arms: arms.map(|arm| PosedArm::of(arm, physics)),
            pairs: all_pairs(),
            smallest_gap_m: f32::INFINITY,
        };
        guard.pose(arms, physics);
        guard
    }

    /// Takes over the arms' postures at the start of a control step.
    pub(crate) fn pose(&mut self, arms: [&Arm; 2], physics: &Physics) {
        self.arms = arms.map(|arm| PosedArm::of(arm, physics));
        self.smallest_gap_m = f32::INFINITY;
        let palms = self.arms.map(|arm| arm.palm_at);
        for pair in &mut self.pairs {
            let gap_m = pair.look(&self.arms, palms).gap_m;
            pair.watched = gap_m < WATCH_WITHIN_M;
            self.smallest_gap_m = self.smallest_gap_m.min(gap_m);
        }
    }

    /// The smallest gap between the arms' links, or links and hands, since the control step began; negative when they
    /// overlap. Metres; exact below the distance at which pairs are watched.
    pub(crate) fn smallest_gap_m(&self) -> f32 {
        self.smallest_gap_m
    }

    /// The palms' wanted velocities as far as the links permit, arm by arm; world frame, metres per second.
    ///
    /// `palms` is where the palms are now, world frame, metres.
    pub(crate) fn limit(&mut self, palms: [Vector; 2], wanted: [Vector; 2]) -> [Vector; 2] {
        let mut limits = [Limits::none(), Limits::none()];
        for pair in self.pairs.iter_mut().filter(|pair| pair.watched) {
            let near = pair.look(&self.arms, palms);
            self.smallest_gap_m = self.smallest_gap_m.min(near.gap_m);
            if near.gap_m < LIMIT_WITHIN_M {
                let least_mps = (-APPROACH_GAIN * near.gap_m).min(SEPARATION_MPS);
                let [first, second] = near.motions;
                limits[0].add(first.transpose() * near.normal, least_mps);
                limits[1].add(second.transpose() * -near.normal, least_mps);
            }
        }
        [limits[0].nearest(wanted[0]), limits[1].nearest(wanted[1])]
    }
}

impl Pair {
    fn look(&mut self, arms: &[PosedArm; 2], palms: [Vector; 2]) -> Nearness {
        let [first, second] = std::array::from_fn(|arm| {
            arms[arm].capsules[self.capsules[arm]].moved_by(palms[arm] - arms[arm].palm_at)
        });
        let [s, t] = nearest_shares(first.axis(), second.axis());
        let offset = first.point(s) - second.point(t);
        let (distance_m, radii_m) = (offset.length(), first.radius_m + second.radius_m);
        let seen = if distance_m > CROSSING_M { Some(offset / distance_m) } else { None };
        let (normal, along_m) = match (seen, self.normal) {
            (Some(seen), Some(known)) if distance_m < radii_m && seen.dot(known) < 0.0 => {
                (-seen, -distance_m)
            }
            (Some(seen), _) => (seen, distance_m),
            (None, known) => (known.unwrap_or(Vector::Z), 0.0),
        };
        self.normal = Some(normal);
        Nearness { gap_m: along_m - radii_m, normal, motions: [first.motion(s), second.motion(t)] }
    }
}

impl Limits {
    fn none() -> Self {
        Self { limits: [Limit { direction: Vector::ZERO, least_mps: 0.0 }; N_PAIRS], n: 0 }
    }

    fn add(&mut self, direction: Vector, least_mps: f32) {
        self.limits[self.n] = Limit { direction, least_mps };
        self.n += 1;
    }

    fn iter(&self) -> impl Iterator<Item = &Limit> {
        self.limits[..self.n].iter()
    }

    /// A velocity near `wanted` within every limit: projected onto the worst one again and again; what is still too
    /// fast an approach after that is scaled back.
    ///
    /// Going by how far limits are exceeded, not by their order, treats both arms alike.
    fn nearest(&self, wanted: Vector) -> Vector {
        let mut velocity = wanted;
        for _ in 0..MAX_PROJECTIONS {
            let worst = self
                .iter()
                .max_by(|a, b| a.missing_mps(velocity).total_cmp(&b.missing_mps(velocity)));
            match worst {
                Some(limit) if limit.missing_mps(velocity) > 1e-4 => {
                    velocity = limit.project(velocity);
                }
                _ => return velocity,
            }
        }
        let scale = self.iter().map(|limit| limit.scale(velocity)).fold(1.0, f32::min);
        velocity * scale
    }
}

impl Limit {
    fn missing_mps(&self, velocity: Vector) -> f32 {
        self.least_mps - self.direction.dot(velocity)
    }

    fn project(&self, velocity: Vector) -> Vector {
        let leverage = self.direction.length_squared().max(LEAST_LEVERAGE * LEAST_LEVERAGE);
        velocity + self.direction * (self.missing_mps(velocity) / leverage)
    }

    /// The share of `velocity` that keeps within this limit, where slowing down helps.
    fn scale(&self, velocity: Vector) -> f32 {
        let speed_mps = self.direction.dot(velocity);
        if speed_mps < self.least_mps && speed_mps < 0.0 {
            (self.least_mps.min(0.0) / speed_mps).min(1.0)
        } else {
            1.0
        }
    }
}

/// Every pair of capsules of which at least one is a link.
fn all_pairs() -> [Pair; N_PAIRS] {
    let mut pairs = [Pair { capsules: [0, 0], normal: None, watched: false }; N_PAIRS];
    let with_link = (0..N_CAPSULES)
        .flat_map(|first| (0..N_CAPSULES).map(move |second| [first, second]))
        .filter(|capsules| capsules.iter().any(|capsule| *capsule < N_LINKS));
    for (pair, capsules) in pairs.iter_mut().zip(with_link) {
        pair.capsules = capsules;
    }
    pairs
}

#[cfg(test)]
mod tests {
    use super::*;
    use tandem_core::rng::{coin, index, uniform};
    use tandem_core::scene::{Capsule, Scene};
    use tandem_core::{Contacts, Layout, Stream, Task, WorldSettings, episode_rng};

    use crate::capsule::{MovedCapsule, MovedPoint};
    use crate::config::WorldConfig;
    use crate::env::Env;

    #[test]
    fn a_pair_that_crosses_keeps_its_side() {
        let capsule = |y_m: f32, along: Vector| {
            let end = |at| MovedPoint { at, motion: Matrix::IDENTITY };
            let ends = [-along, along].map(|offset| end(offset + Vector::Y * y_m));
            MovedCapsule { ends, radius_m: 0.04 }
        };
        let arm = |y_m, along| PosedArm {
            palm_at: Vector::ZERO,
            capsules: [capsule(y_m, along); N_CAPSULES],
        };
        let arms = [arm(0.1, Vector::X), arm(0.0, Vector::Z)];
        let mut pair = all_pairs()[0];
        let gaps: Vec<f32> = (0_u8..16)
            .map(|step| {
                let near =
                    pair.look(&arms, [Vector::NEG_Y * (0.01 * f32::from(step)), Vector::ZERO]);
                assert!((near.normal - Vector::Y).length() < 1e-5, "step {step}: {}", near.normal);
                near.gap_m
            })
            .collect();
        assert!((gaps[0] - 0.02).abs() < 1e-6 && (gaps[15] + 0.13).abs() < 1e-6, "{gaps:?}");
        assert!(gaps.is_sorted_by(|before, after| before > after), "{gaps:?}");
    }

    #[test]
    fn a_limited_velocity_respects_every_limit() {
        let mut rng = episode_rng(5, 0, Stream::Exploration);
        let mut vector =
            |size: f32| Vector::from_array(std::array::from_fn(|_| uniform(&mut rng, -size, size)));
        for _ in 0..1000 {
            let mut limits = Limits::none();
            for least_mps in [0.0, -0.05, -0.2, -0.4] {
                limits.add(vector(1.0).normalize_or_zero(), least_mps);
            }
            let velocity = limits.nearest(vector(1.5));
            assert!(limits.iter().all(|limit| limit.missing_mps(velocity) < 1e-3), "{velocity}");
        }
    }

    /// How an arm that wants to do harm moves: held random actions, or straight for a part of the other arm.
    fn attack(scene: &Scene, arm: usize, aim: usize) -> [f32; 3] {
        let other = &scene.arms[1 - arm];
        let aims = [
            other.end_effector,
            other.joint_points[2],
            other.joint_points[4],
            other.joint_points[5],
        ];
        let sign = if arm == 0 { 1.0 } else { -1.0 };
        let to = |axis: usize| {
            ((aims[aim][axis] - scene.arms[arm].end_effector[axis]) * 20.0).clamp(-1.0, 1.0)
        };
        [sign * to(0), sign * to(1), to(2)]
    }

    /// The smallest gap between links as the joints of this very moment give it.
    fn true_gap_m(scene: &Scene) -> f32 {
        let axis = |link: &Capsule| [Vector::from_array(link.from), Vector::from_array(link.to)];
        let gap = |first: &Capsule, second: &Capsule| {
            let [s, t] = nearest_shares(axis(first), axis(second));
            let point = |link: &Capsule, share: f32| axis(link)[0].lerp(axis(link)[1], share);
            (point(first, s) - point(second, t)).length() - first.radius_m - second.radius_m
        };
        let [first, second] = [&scene.arms[0].links, &scene.arms[1].links];
        first
            .iter()
            .flat_map(|link| second.iter().map(move |other| gap(link, other)))
            .fold(f32::INFINITY, f32::min)
    }

    #[test]
    fn links_hardly_overlap_under_attack() {
        let layout = Layout::new(Task::PickAndPlace, 2);
        let mut env = Env::new(layout, &WorldConfig::default()).unwrap();
        let (mut overlapping, mut deepest_m) = (0, 0.0_f32);
        for episode in 0..200 {
            let mut rng = episode_rng(9, episode, Stream::Exploration);
            env.reset(&mut episode_rng(9, episode, Stream::Reset), WorldSettings::default());
            let mut action = [0.0; 8];
            let mut aims = [0; 2];
            let attackers = [coin(&mut rng, 0.7), coin(&mut rng, 0.7)];
            let mut smallest_m = f32::INFINITY;
            for step in 0..50 {
                let scene = env.scene();
                for arm in 0..2 {
                    let part = &mut action[arm * 4..arm * 4 + 3];
                    if step % 10 == 0 {
                        aims[arm] = index(&mut rng, 4);
                    }
                    if attackers[arm] {
                        part.copy_from_slice(&attack(&scene, arm, aims[arm]));
                    } else if step % 4 == 0 {
                        part.fill_with(|| uniform(&mut rng, -1.0, 1.0));
                    }
                }
                let contacts = env.step(&action).unwrap();
                let gap_m = true_gap_m(&env.scene());
                assert!(
                    gap_m > -0.003 || contacts.contains(Contacts::ARM_ARM),
                    "overlap of {gap_m} m not told"
                );
                smallest_m = smallest_m.min(gap_m);
            }
            overlapping += u32::from(smallest_m < 0.0);
            deepest_m = deepest_m.max(-smallest_m);
        }
        println!("links overlap in {overlapping} of 200 attacks, by {deepest_m} m at most");
        assert!(
            deepest_m < 0.01 && overlapping < 80,
            "{overlapping} overlaps, up to {deepest_m} m"
        );
    }
}
