//! A velocity damper that keeps the links of two arms apart (Faverjon & Tournassoud 1987).
//!
//! The links are not rapier bodies: as bodies posed by inverse kinematics they would push with unlimited force.
//! Instead, the desired velocity of each arm is limited along the normal of every close pair of capsules. The approach
//! speed may be at most [`APPROACH_GAIN`] times the gap, and capsules that overlap must separate. The limit acts
//! through the palm's bounded servo.
//!
//! Overlapping capsules keep the normal from before the overlap. When their axes cross, the direction between their
//! closest points reverses; with the reversed normal the damper would pull the links through each other.

use rapier3d::math::{Matrix, Vector};

use crate::arm::Arm;
use crate::capsule::{ArmCapsules, N_CAPSULES, N_LINKS, closest_fractions};
use crate::physics::Physics;

/// Number of pairs of capsules of two hands, which collide with each other in rapier.
const N_HAND_PAIRS: usize = (N_CAPSULES - N_LINKS) * (N_CAPSULES - N_LINKS);
/// Number of pairs of capsules with at least one link.
const N_PAIRS: usize = N_CAPSULES * N_CAPSULES - N_HAND_PAIRS;

/// Largest approach speed of an arm per metre of gap, 1/s.
pub(crate) const APPROACH_GAIN: f32 = 20.0;
/// Largest speed of separation that an overlap demands, metres per second.
pub(crate) const SEPARATION_MPS: f32 = 0.4;
/// Gap above which a pair imposes no limit, metres.
pub(crate) const INFLUENCE_DISTANCE_M: f32 = 0.08;
/// Gap at the start of a control step above which a pair cannot come within [`INFLUENCE_DISTANCE_M`] during the step,
/// metres.
pub(crate) const ACTIVATION_DISTANCE_M: f32 = 0.24;
/// Distance between two axes below which the direction between them is undefined, metres.
pub(crate) const CROSSING_M: f32 = 0.002;
/// Lower bound on the norm of a limit's direction, as a fraction of the palm's motion. Without it, the palm would have
/// to move very fast to displace a point that hardly follows it.
pub(crate) const MIN_DIRECTION_NORM: f32 = 0.3;
/// Largest number of projections of a velocity before it is scaled down instead.
pub(crate) const MAX_PROJECTIONS: usize = 12;

/// Violation of a limit that counts as none, metres per second.
pub(crate) const VIOLATION_TOLERANCE_MPS: f32 = 1e-4;

/// A capsule of the first arm and one of the second.
#[derive(Clone, Copy)]
struct Pair {
    capsules: [usize; 2],
    /// Unit vector towards the first arm's capsule at the last update.
    normal: Option<Vector>,
    /// Whether the pair can come within the influence distance during this control step.
    active: bool,
}

/// The gap of a pair in one physics step and its derivatives.
struct Proximity {
    gap_m: f32,
    /// Unit vector towards the first arm's capsule.
    normal: Vector,
    /// For each arm, the Jacobian of the capsule's closest point with respect to the palm's position.
    jacobians: [Matrix; 2],
}

/// A constraint on the velocity of a palm: `direction · velocity >= min_mps`.
#[derive(Clone, Copy)]
struct Limit {
    direction: Vector,
    min_mps: f32,
}

/// The constraints on one arm in one physics step: the first `n` of `limits`.
struct Limits {
    limits: [Limit; N_PAIRS],
    n: usize,
}

/// The velocity damper between two arms.
#[derive(Clone)]
pub(crate) struct VelocityDamper {
    arms: [ArmCapsules; 2],
    pairs: [Pair; N_PAIRS],
    /// The pairs whose gaps are measured and impose no limits; none unless hands are watched.
    hand_pairs: Option<[Pair; N_HAND_PAIRS]>,
    min_gap_m: f32,
    min_hand_gap_m: f32,
    n_interventions: u32,
}

impl VelocityDamper {
    /// Creates a damper for `arms` at their current positions. It measures gaps between hands as well if it
    /// `watches_hands`.
    pub(crate) fn new(arms: [&Arm; 2], physics: &Physics, watches_hands: bool) -> Self {
        let mut damper = Self {
            arms: arms.map(|arm| ArmCapsules::of(arm, physics)),
            pairs: pairs(|capsules| capsules.iter().any(|capsule| *capsule < N_LINKS)),
            hand_pairs: watches_hands
                .then(|| pairs(|capsules| capsules.iter().all(|capsule| *capsule >= N_LINKS))),
            min_gap_m: f32::INFINITY,
            min_hand_gap_m: f32::INFINITY,
            n_interventions: 0,
        };
        damper.update_posture(arms, physics);
        damper
    }

    /// Updates the capsules to the joint angles at the start of a control step.
    pub(crate) fn update_posture(&mut self, arms: [&Arm; 2], physics: &Physics) {
        self.arms = arms.map(|arm| ArmCapsules::of(arm, physics));
        self.min_gap_m = f32::INFINITY;
        self.min_hand_gap_m = f32::INFINITY;
        self.n_interventions = 0;
        let palms = self.arms.map(|arm| arm.palm_position);
        for pair in &mut self.pairs {
            let gap_m = pair.update(&self.arms, palms).gap_m;
            pair.active = gap_m < ACTIVATION_DISTANCE_M;
            self.min_gap_m = self.min_gap_m.min(gap_m);
        }
        self.measure_hands(palms);
    }

    /// Returns the smallest gap between hands since the start of the control step, metres; infinite if they are not
    /// watched.
    pub(crate) fn min_hand_gap_m(&self) -> f32 {
        self.min_hand_gap_m
    }

    fn measure_hands(&mut self, palms: [Vector; 2]) {
        for pair in self.hand_pairs.iter_mut().flatten() {
            self.min_hand_gap_m = self.min_hand_gap_m.min(pair.update(&self.arms, palms).gap_m);
        }
    }

    /// Returns the smallest gap between links, or links and hands, since the start of the control step, metres. It is
    /// negative if they overlap, and meaningful only below [`ACTIVATION_DISTANCE_M`]. Within a control step it is a
    /// prediction of first order from the posture at the step's start: a hand of the shared world moves up to 5 cm in a
    /// step, in which a link of a Mico can be some millimetres from where it is predicted, 14 mm at most.
    pub(crate) fn min_gap_m(&self) -> f32 {
        self.min_gap_m
    }

    /// Limits the desired velocities of the palms, in arm order; world frame, metres per second.
    ///
    /// `palms` are the current positions of the palms, world frame, metres.
    pub(crate) fn limit(&mut self, palms: [Vector; 2], desired: [Vector; 2]) -> [Vector; 2] {
        self.measure_hands(palms);
        let mut limits = [Limits::none(), Limits::none()];
        for pair in self.pairs.iter_mut().filter(|pair| pair.active) {
            let proximity = pair.update(&self.arms, palms);
            self.min_gap_m = self.min_gap_m.min(proximity.gap_m);
            if proximity.gap_m < INFLUENCE_DISTANCE_M {
                let min_mps = (-APPROACH_GAIN * proximity.gap_m).min(SEPARATION_MPS);
                let [first, second] = proximity.jacobians;
                limits[0].add(first.transpose() * proximity.normal, min_mps);
                limits[1].add(second.transpose() * -proximity.normal, min_mps);
            }
        }
        let limited = [limits[0].project(desired[0]), limits[1].project(desired[1])];
        self.n_interventions += u32::from(limited != desired);
        limited
    }

    /// Returns the number of calls of [`limit`](Self::limit) since the start of the control step that changed a
    /// velocity.
    pub(crate) fn n_interventions(&self) -> u32 {
        self.n_interventions
    }
}

impl Pair {
    fn update(&mut self, arms: &[ArmCapsules; 2], palms: [Vector; 2]) -> Proximity {
        let [first, second] = std::array::from_fn(|arm| {
            arms[arm].capsules[self.capsules[arm]].moved_by(palms[arm] - arms[arm].palm_position)
        });
        let [s, t] = closest_fractions(first.axis(), second.axis());
        let offset = first.point(s) - second.point(t);
        let (distance_m, radii_m) = (offset.length(), first.radius_m + second.radius_m);
        let measured = if distance_m > CROSSING_M { Some(offset / distance_m) } else { None };
        let (normal, signed_distance_m) = match (measured, self.normal) {
            (Some(measured), Some(previous))
                if distance_m < radii_m && measured.dot(previous) < 0.0 =>
            {
                (-measured, -distance_m)
            }
            (Some(measured), _) => (measured, distance_m),
            (None, previous) => (previous.unwrap_or(Vector::Z), 0.0),
        };
        self.normal = Some(normal);
        Proximity {
            gap_m: signed_distance_m - radii_m,
            normal,
            jacobians: [first.jacobian(s), second.jacobian(t)],
        }
    }
}

impl Limits {
    fn none() -> Self {
        Self { limits: [Limit { direction: Vector::ZERO, min_mps: 0.0 }; N_PAIRS], n: 0 }
    }

    fn add(&mut self, direction: Vector, min_mps: f32) {
        self.limits[self.n] = Limit { direction, min_mps };
        self.n += 1;
    }

    fn iter(&self) -> impl Iterator<Item = &Limit> {
        self.limits[..self.n].iter()
    }

    /// Returns a velocity near `desired` that satisfies every limit. It is projected repeatedly onto the limit with the
    /// largest violation; if violations remain, it is scaled down.
    ///
    /// The order of projections depends on the violations and not on the order of the limits, so both arms are treated
    /// alike.
    fn project(&self, desired: Vector) -> Vector {
        let mut velocity = desired;
        for _ in 0..MAX_PROJECTIONS {
            let worst = self
                .iter()
                .max_by(|a, b| a.violation_mps(velocity).total_cmp(&b.violation_mps(velocity)));
            match worst {
                Some(limit) if limit.violation_mps(velocity) > VIOLATION_TOLERANCE_MPS => {
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
    fn violation_mps(&self, velocity: Vector) -> f32 {
        self.min_mps - self.direction.dot(velocity)
    }

    fn project(&self, velocity: Vector) -> Vector {
        let squared_norm =
            self.direction.length_squared().max(MIN_DIRECTION_NORM * MIN_DIRECTION_NORM);
        velocity + self.direction * (self.violation_mps(velocity) / squared_norm)
    }

    /// Returns the factor by which to scale `velocity` down to satisfy this limit, 1 if that does not help.
    fn scale(&self, velocity: Vector) -> f32 {
        let speed_mps = self.direction.dot(velocity);
        if speed_mps < self.min_mps && speed_mps < 0.0 {
            (self.min_mps.min(0.0) / speed_mps).min(1.0)
        } else {
            1.0
        }
    }
}

/// Returns the pairs of capsules that `belongs` selects, of which there are `N`.
fn pairs<const N: usize>(belongs: impl Fn(&[usize; 2]) -> bool) -> [Pair; N] {
    let mut pairs = [Pair { capsules: [0, 0], normal: None, active: false }; N];
    let all = (0..N_CAPSULES).flat_map(|first| (0..N_CAPSULES).map(move |second| [first, second]));
    for (pair, capsules) in pairs.iter_mut().zip(all.filter(belongs)) {
        pair.capsules = capsules;
    }
    pairs
}

#[cfg(test)]
mod tests {
    use super::*;
    use tandem_core::rng::{bernoulli, index, uniform};
    use tandem_core::scene::{Capsule, Scene};
    use tandem_core::{Contacts, Layout, Stream, Task, WorldSettings, episode_rng};

    use crate::capsule::{ArmCapsule, ArmPoint};
    use crate::config::WorldConfig;
    use crate::env::Env;

    #[test]
    fn capsules_that_cross_keep_their_normal() {
        let capsule = |y_m: f32, along: Vector| {
            let end = |position| ArmPoint { position, jacobian: Matrix::IDENTITY };
            let ends = [-along, along].map(|offset| end(offset + Vector::Y * y_m));
            ArmCapsule { ends, radius_m: 0.04 }
        };
        let arm = |y_m, along| ArmCapsules {
            palm_position: Vector::ZERO,
            capsules: [capsule(y_m, along); N_CAPSULES],
        };
        let arms = [arm(0.1, Vector::X), arm(0.0, Vector::Z)];
        let mut pair = pairs::<N_PAIRS>(|_| true)[0];
        let gaps: Vec<f32> = (0_u8..16)
            .map(|step| {
                let proximity =
                    pair.update(&arms, [Vector::NEG_Y * (0.01 * f32::from(step)), Vector::ZERO]);
                assert!(
                    (proximity.normal - Vector::Y).length() < 1e-5,
                    "step {step}: {}",
                    proximity.normal
                );
                proximity.gap_m
            })
            .collect();
        assert!((gaps[0] - 0.02).abs() < 1e-6 && (gaps[15] + 0.13).abs() < 1e-6, "{gaps:?}");
        assert!(gaps.is_sorted_by(|before, after| before > after), "{gaps:?}");
    }

    #[test]
    fn a_limited_velocity_satisfies_every_limit() {
        let mut rng = episode_rng(5, 0, Stream::Exploration);
        let mut vector =
            |size: f32| Vector::from_array(std::array::from_fn(|_| uniform(&mut rng, -size, size)));
        for _ in 0..1000 {
            let mut limits = Limits::none();
            for min_mps in [0.0, -0.05, -0.2, -0.4] {
                limits.add(vector(1.0).normalize_or_zero(), min_mps);
            }
            let velocity = limits.project(vector(1.5));
            assert!(limits.iter().all(|limit| limit.violation_mps(velocity) < 1e-3), "{velocity}");
        }
    }

    /// The action of an arm that moves straight at a part of the other arm.
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

    /// The smallest gap between links at the current joint angles.
    fn true_gap_m(scene: &Scene) -> f32 {
        let axis = |link: &Capsule| [Vector::from_array(link.from), Vector::from_array(link.to)];
        let gap = |first: &Capsule, second: &Capsule| {
            let [s, t] = closest_fractions(axis(first), axis(second));
            let point = |link: &Capsule, fraction: f32| axis(link)[0].lerp(axis(link)[1], fraction);
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
            let attackers = [bernoulli(&mut rng, 0.7), bernoulli(&mut rng, 0.7)];
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
                    "overlap of {gap_m} m not reported"
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
