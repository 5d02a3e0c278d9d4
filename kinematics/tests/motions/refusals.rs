//! The check accepts good motions and names the first violation of bad ones.

use std::f64::consts::TAU;

use nalgebra::Point3;
use rand::RngExt as _;
use rand_chacha::ChaCha8Rng;
use tandem_core::{ArmIndex, Stream, episode_rng};
use tandem_kinematics::{
    ArmSample, CheckSettings, ForwardKinematics, Joints, MICO_4, Motion, Reason, Refusal, WorkCell,
    check,
};

use crate::walks::{Area, sampled, walk};

const N_GOOD: u64 = 200;
const N_GOOD_WITH_TIME: u64 = 1000;
/// Motions broken in each way.
pub(crate) const N_BROKEN: usize = 200;
pub(crate) const PERIOD_S: f64 = 0.01;

#[test]
fn good_walks_are_accepted() {
    accept_walks(N_GOOD);
}

#[test]
#[ignore = "takes a quarter of a minute"]
fn a_thousand_good_walks_are_accepted() {
    accept_walks(N_GOOD_WITH_TIME);
}

#[expect(clippy::print_stdout, reason = "measurements for --nocapture")]
fn accept_walks(n_walks: u64) {
    let cell = WorkCell::mico_pair();
    let (mut seconds, mut longest_s) = (0.0, 0.0_f64);
    for seed in 0..n_walks {
        let (motion, at) = sampled(&cell, &walk(&cell, Area::TASKS, seed, 50));
        if let Err(refusal) = check(&cell, &motion, &at, &CheckSettings::default()) {
            panic!("walk {seed}: {refusal}");
        }
        let duration_s = (motion.arms[0].len() - 1) as f64 * PERIOD_S;
        seconds += duration_s;
        longest_s = longest_s.max(duration_s);
    }
    println!(
        "{n_walks} walks, {:.1} s each, {longest_s:.1} s the longest",
        seconds / n_walks as f64
    );
}

/// A motion to be broken, and the present joint angles.
#[derive(Clone)]
struct Case {
    motion: Motion,
    at: Vec<Joints>,
    settings: CheckSettings,
}

impl Case {
    fn n_samples(&self) -> usize {
        self.motion.arms[0].len()
    }

    fn check(&self, cell: &WorkCell) -> Result<(), Refusal> {
        check(cell, &self.motion, &self.at, &self.settings)
    }

    /// Returns a random sample other than the first and the last.
    fn sample(&mut self, rng: &mut ChaCha8Rng) -> (ArmIndex, usize, &mut ArmSample) {
        let arm = rng.random_range(0..2);
        let idx = rng.random_range(1..self.n_samples() - 1);
        (ArmIndex(arm), idx, &mut self.motion.arms[arm][idx])
    }
}

/// Returns good motions in which the arms are far apart, so that one limit can be violated without another.
fn pool(cell: &WorkCell) -> Vec<Case> {
    (0..20)
        .map(|seed| {
            let (motion, at) = sampled(cell, &walk(cell, Area::FAR, seed, 6));
            let case = Case { motion, at, settings: CheckSettings::default() };
            assert_eq!(case.check(cell), Ok(()), "walk {seed}");
            case
        })
        .collect()
}

/// The expected refusal: arm, earliest and latest time, and kind of reason.
struct Expected {
    arm: ArmIndex,
    between_s: [f64; 2],
    reason: fn(&Reason) -> bool,
}

impl Expected {
    /// Expects a refusal in the interval before sample `idx` or at that sample.
    fn around(arm: ArmIndex, idx: usize, reason: fn(&Reason) -> bool) -> Option<Self> {
        let at_s = idx as f64 * PERIOD_S;
        Some(Self { arm, between_s: [at_s - PERIOD_S, at_s], reason })
    }

    fn at_start(arm: usize, reason: fn(&Reason) -> bool) -> Option<Self> {
        Some(Self { arm: ArmIndex(arm), between_s: [0.0, 0.0], reason })
    }
}

/// Breaks motions of the pool with `how`, which returns the expected refusal, or `None` if the motion is unsuitable.
fn break_all(name: &str, how: impl Fn(&mut Case, &mut ChaCha8Rng) -> Option<Expected>) {
    let cell = WorkCell::mico_pair();
    let pool = pool(&cell);
    let mut rng = episode_rng(7, 0, Stream::Exploration);
    let (mut broken, mut tried) = (0, 0);
    while broken < N_BROKEN {
        let mut case = pool[tried % pool.len()].clone();
        tried += 1;
        assert!(tried < 50 * N_BROKEN, "{name}: hardly any motion is suitable");
        let Some(expected) = how(&mut case, &mut rng) else { continue };
        broken += 1;
        let refusal = case.check(&cell).expect_err(name);
        assert!((expected.reason)(&refusal.reason), "{name}: {refusal}");
        assert_eq!(refusal.arm, expected.arm, "{name}: {refusal}");
        let [from_s, to_s] = expected.between_s;
        assert!(
            (from_s - 1e-9..=to_s + 1e-9).contains(&refusal.when_s),
            "{name}: {refusal}, expected from {from_s} to {to_s} s"
        );
    }
}

#[test]
fn numbers_that_are_not_finite_are_refused() {
    break_all("not finite", |case, rng| {
        let none = [f64::NAN, f64::INFINITY, f64::NEG_INFINITY][rng.random_range(0..3)];
        let (arm, idx, sample) = case.sample(rng);
        match rng.random_range(0..9) {
            joint @ 0..4 => sample.angles[joint] = none,
            joint @ 4..8 => sample.velocities[joint - 4] = none,
            _ => sample.gripper_opening = none,
        }
        Expected::around(arm, idx, |reason| *reason == Reason::NotFinite)
    });
}

#[test]
fn gripper_openings_out_of_range_or_too_fast_are_refused() {
    break_all("opening", |case, rng| {
        let beyond = rng.random_range(1e-6..0.5);
        let opening = if rng.random_bool(0.5) { 1.0 + beyond } else { -beyond };
        let (arm, idx, sample) = case.sample(rng);
        sample.gripper_opening = opening;
        Expected::around(arm, idx, |reason| matches!(reason, Reason::GripperOpening(_)))
    });
    break_all("opening speed", |case, rng| {
        let by = rng.random_range(0.1..0.5);
        let (arm, idx, sample) = case.sample(rng);
        sample.gripper_opening += if sample.gripper_opening < 0.5 { by } else { -by };
        Expected::around(arm, idx, |reason| matches!(reason, Reason::GripperSpeed(_)))
    });
}

#[test]
fn jumps_kicks_and_lost_samples() {
    break_all("jump", |case, rng| {
        let (joint, by) = (rng.random_range(0..4), rng.random_range(0.002..0.1));
        let (arm, idx, sample) = case.sample(rng);
        sample.angles[joint] += by;
        Expected::around(arm, idx, |reason| matches!(reason, Reason::JointAcceleration(..)))
    });
    break_all("kick", |case, rng| {
        let (joint, by) = (rng.random_range(0..4), rng.random_range(0.07..0.3));
        let (arm, idx, sample) = case.sample(rng);
        sample.velocities[joint] -= by;
        Expected::around(arm, idx, |reason| matches!(reason, Reason::JointAcceleration(..)))
    });
    break_all("lost samples", |case, rng| {
        let idx = rng.random_range(10..case.n_samples() - 20);
        // Only a jump of the first arm that is fast enough is certain to be refused.
        let rates = &case.motion.arms[0][idx].velocities;
        if rates.iter().all(|rate| rate.abs() < 0.1) {
            return None;
        }
        for samples in &mut case.motion.arms {
            samples.drain(idx..idx + 5);
        }
        Expected::around(ArmIndex(0), idx, |r| matches!(r, Reason::JointAcceleration(..)))
    });
}

#[test]
fn joints_beyond_their_range_are_refused() {
    break_all("joint range", |case, rng| {
        // A full turn changes nothing but the angle.
        let arm = rng.random_range(0..2);
        let joint = [0, 3][rng.random_range(0..2)];
        let turn = if rng.random_bool(0.5) { TAU } else { -TAU };
        for sample in &mut case.motion.arms[arm] {
            sample.angles[joint] += turn;
        }
        case.at[arm][joint] += turn;
        let beyond = |sample: &ArmSample| sample.angles[joint].abs() > TAU;
        let idx = case.motion.arms[arm].iter().position(beyond)?;
        if case.motion.arms[arm][idx].angles[joint].abs() < TAU + 1e-6 {
            return None;
        }
        Expected::around(ArmIndex(arm), idx, |reason| matches!(reason, Reason::JointRange(..)))
    });
}

/// Returns angle and velocity of a trapezoidal profile that starts at time 0.
fn trapezoid(time_s: f64, [ramp_s, flat_s]: [f64; 2], acceleration: f64) -> [f64; 2] {
    let speed = acceleration * ramp_s;
    let (flat_end_s, end_s) = (ramp_s + flat_s, 2.0 * ramp_s + flat_s);
    if time_s <= 0.0 {
        [0.0, 0.0]
    } else if time_s < ramp_s {
        [0.5 * acceleration * time_s * time_s, acceleration * time_s]
    } else if time_s < flat_end_s {
        [speed * (time_s - 0.5 * ramp_s), speed]
    } else if time_s < end_s {
        let left_s = end_s - time_s;
        let end = speed * (ramp_s + flat_s);
        [end - 0.5 * acceleration * left_s * left_s, acceleration * left_s]
    } else {
        [speed * (ramp_s + flat_s), 0.0]
    }
}

/// Makes `joint` of an otherwise resting arm follow a trapezoidal profile from 0.1 s on.
fn swing(case: &mut Case, arm: usize, joint: usize, ramp_s: f64, acceleration: f64) {
    let first = case.motion.arms[arm][0];
    for samples in &mut case.motion.arms {
        let rest = samples[0];
        samples.clear();
        samples.resize(150, rest);
    }
    for (idx, sample) in case.motion.arms[arm].iter_mut().enumerate() {
        let [angle, rate] = trapezoid(idx as f64 * PERIOD_S - 0.1, [ramp_s, 0.2], acceleration);
        sample.angles[joint] = first.angles[joint] + angle;
        sample.velocities[joint] = rate;
    }
}

#[test]
fn joints_that_are_too_fast_or_accelerate_too_much_are_refused() {
    // Joint 4 rotates nothing but the fingers.
    let (speed, acceleration) = (48.0_f64.to_radians(), 4.0 * 48.0_f64.to_radians());
    break_all("joint speed", |case, rng| {
        let arm = rng.random_range(0..2);
        let used = rng.random_range(0.6..0.95) * acceleration;
        let ramp_s = rng.random_range(1.02..1.2) * speed / used;
        swing(case, arm, 3, ramp_s, used);
        let over_s = 0.1 + speed / used;
        Some(Expected {
            arm: ArmIndex(arm),
            between_s: [over_s - PERIOD_S, over_s + PERIOD_S],
            reason: |reason| matches!(reason, Reason::JointSpeed(3, _)),
        })
    });
    break_all("joint acceleration", |case, rng| {
        let arm = rng.random_range(0..2);
        let used = rng.random_range(1.02..1.6) * acceleration;
        swing(case, arm, 3, 0.9 * speed / used, used);
        Expected::around(ArmIndex(arm), 11, |r| matches!(r, Reason::JointAcceleration(3, _)))
    });
    break_all("neither", |case, rng| {
        // A motion within both limits is accepted; then the acceleration limit is lowered below it.
        let arm = rng.random_range(0..2);
        swing(case, arm, 3, 0.99 * speed / acceleration, 0.99 * acceleration);
        assert_eq!(case.check(&WorkCell::mico_pair()), Ok(()));
        case.settings.limits.ramp_s *= 1.05;
        Expected::around(ArmIndex(arm), 11, |r| matches!(r, Reason::JointAcceleration(3, _)))
    });
}

#[test]
fn tools_that_are_too_fast_are_refused() {
    let cell = WorkCell::mico_pair();
    break_all("tool speed", |case, rng| {
        // An arm stretched out sideways swings away from the other one, within the speed limit of its joint.
        let arm = rng.random_range(0..2);
        let radius_m = rng.random_range(0.345..0.36);
        let at_m = Point3::new(0.6 * radius_m, 0.8 * radius_m, rng.random_range(0.06..0.12));
        let placed = &cell.arms[arm];
        let seed = Joints::new(MICO_4.elbow_up_rad);
        let target = placed.target(&(placed.world_from_base() * at_m));
        let angles = MICO_4.inverse_kinematics(&target, &seed).unwrap().angles;
        case.motion.arms[arm][0].angles = angles;
        case.at[arm] = angles;
        let (joint_speed, acceleration) = (0.62, 2.4);
        swing(case, arm, 0, joint_speed / acceleration, -acceleration);
        let over_s = 0.1 + 0.20 / radius_m / acceleration;
        Some(Expected {
            arm: ArmIndex(arm),
            between_s: [over_s - PERIOD_S, over_s + PERIOD_S],
            reason: |reason| matches!(reason, Reason::ToolSpeed(_)),
        })
    });
}

#[test]
fn motions_that_do_not_start_at_the_arms_or_do_not_rest_at_both_ends_are_refused() {
    break_all("cut at the end", |case, rng| {
        let n = rng.random_range(20..case.n_samples() - 10);
        let moves =
            |samples: &Vec<ArmSample>| samples[n - 1].velocities.iter().any(|v| v.abs() > 1e-5);
        let arm = case.motion.arms.iter().position(moves)?;
        case.motion.arms.iter_mut().for_each(|samples| samples.truncate(n));
        Expected::around(ArmIndex(arm), n - 1, |reason| matches!(reason, Reason::NotAtRest(..)))
    });
    break_all("cut at the start", |case, rng| {
        let n = rng.random_range(10..case.n_samples() - 20);
        for (samples, at) in case.motion.arms.iter_mut().zip(&mut case.at) {
            samples.drain(..n);
            *at = samples[0].angles;
        }
        let moves = |samples: &Vec<ArmSample>| samples[0].velocities.iter().any(|v| v.abs() > 1e-5);
        let arm = case.motion.arms.iter().position(moves)?;
        Expected::at_start(arm, |reason| matches!(reason, Reason::NotAtRest(..)))
    });
    break_all("elsewhere", |case, rng| {
        let (arm, joint) = (rng.random_range(0..2), rng.random_range(0..4));
        let by = rng.random_range(1.01_f64..90.0).to_radians();
        case.at[arm][joint] += if rng.random_bool(0.5) { by } else { -by };
        Expected::at_start(arm, |reason| matches!(reason, Reason::Start(..)))
    });
    break_all("no position", |case, rng| {
        let (arm, joint) = (rng.random_range(0..2), rng.random_range(0..4));
        case.at[arm][joint] = f64::NAN;
        Expected::at_start(arm, |reason| *reason == Reason::NotFinite)
    });
}

#[test]
fn motions_of_other_arms_or_of_invalid_length_are_refused() {
    break_all("length", |case, rng| {
        let n = case.n_samples();
        case.settings.duration_s = n as f64 * PERIOD_S;
        let longer = n + rng.random_range(2..100);
        for samples in &mut case.motion.arms {
            let rest = samples[n - 1];
            samples.resize(longer, rest);
        }
        Expected::at_start(0, |reason| matches!(reason, Reason::Duration(_)))
    });
    break_all("period", |case, rng| {
        case.motion.period_s = [0.0, -0.01, f64::NAN, f64::INFINITY][rng.random_range(0..4)];
        Expected::at_start(0, |reason| matches!(reason, Reason::Duration(_)))
    });
    break_all("samples", |case, rng| {
        let left = rng.random_range(0..case.n_samples());
        case.motion.arms[1].truncate(left);
        Expected::at_start(1, |reason| matches!(reason, Reason::Samples { .. }))
    });
    break_all("arms", |case, rng| {
        let arms = if rng.random_bool(0.5) { 1 } else { 3 };
        let other = case.motion.arms[0].clone();
        case.motion.arms.resize(arms, other);
        Expected::at_start(0, |reason| matches!(reason, Reason::Arms { expected: 2, .. }))
    });
    break_all("joints", |case, rng| {
        let n_joints = [0, 3, 5, 6][rng.random_range(0..4)];
        let (arm, idx, sample) = case.sample(rng);
        sample.angles = Joints::from_fn(n_joints, |_| 0.0);
        let at_s = idx as f64 * PERIOD_S;
        let reason = |reason: &Reason| matches!(reason, Reason::Joints { expected: 4, .. });
        Some(Expected { arm, between_s: [at_s, at_s], reason })
    });
    break_all("settings", |case, rng| {
        let bad = [-1.0, f64::NAN, f64::INFINITY][rng.random_range(0..3)];
        match rng.random_range(0..6) {
            0 => case.settings.tilt_rad = bad,
            1 => case.settings.arms_gap_m = bad,
            2 => case.settings.table_gap_m = bad,
            3 => case.settings.limits.tool_speed_mps = bad,
            4 => case.settings.self_gap_m = bad,
            _ => case.settings.start_rad = bad,
        }
        Expected::at_start(0, |reason| matches!(reason, Reason::Setting(..)))
    });
}

#[test]
fn tools_that_reach_too_far_are_refused() {
    let shoulder_m = MICO_4.shoulder_m();
    let distance_m = |q: &Joints| (ForwardKinematics::new(&MICO_4, q).tool_m() - shoulder_m).norm();
    break_all("reach", |case, rng| {
        // The limit lies between the smallest and the largest distance of the motion.
        let arms = &case.motion.arms;
        let at = |idx: usize| {
            arms.iter().map(|samples| distance_m(&samples[idx].angles)).fold(0.0, f64::max)
        };
        let all: Vec<f64> = (0..case.n_samples()).map(at).collect();
        let most_m = all.iter().copied().fold(0.0, f64::max);
        let limit_m = all[0] + rng.random_range(0.1..0.9) * (most_m - all[0]);
        if limit_m < all[0] + 0.003 || most_m < limit_m + 0.003 {
            return None;
        }
        case.settings.reach_share = limit_m / MICO_4.reach_m();
        let first = |slack_m: f64| all.iter().position(|d| *d > limit_m + slack_m);
        let (from, to) = (first(0.0)?, first(2e-4)?);
        let arm = arms.iter().position(|s| distance_m(&s[to].angles) > limit_m + 1e-4)?;
        let both = arms.iter().all(|s| distance_m(&s[to].angles) > limit_m - 1e-3);
        (!both).then_some(Expected {
            arm: ArmIndex(arm),
            between_s: [from as f64 * PERIOD_S - PERIOD_S, to as f64 * PERIOD_S],
            reason: |reason| matches!(reason, Reason::Reach(_)),
        })
    });
}

#[test]
fn a_refusal_names_arm_time_value_and_limit() {
    let cell = WorkCell::mico_pair();
    let (mut motion, at) = sampled(&cell, &walk(&cell, Area::FAR, 1, 6));
    motion.arms[1][40].gripper_opening = 1.5;
    let refusal = check(&cell, &motion, &at, &CheckSettings::default()).unwrap_err();
    assert_eq!(
        refusal.to_string(),
        "at 0.400 s arm 1: the gripper opening is 1.5, expected 0 to 1"
    );
    motion.arms[1][40].gripper_opening = 0.5;
    let elsewhere: Vec<Joints> =
        at.iter().map(|q| Joints::from_fn(4, |joint| q[joint] + 0.1)).collect();
    let refusal = check(&cell, &motion, &elsewhere, &CheckSettings::default()).unwrap_err();
    assert_eq!(
        refusal.to_string(),
        "at 0.000 s arm 0: joint 1 is 5.73 degrees from the start of the motion, at most 1.00"
    );
}
