//! No motion leads an arm into itself: the check against forward kinematics and distances of this file's own.

use std::f64::consts::{FRAC_PI_2, FRAC_PI_3, PI};

use glam::{DMat3, DVec3};
use rand::RngExt as _;
use rand_chacha::ChaCha8Rng;
use tandem_core::{ArmIndex, Stream, episode_rng};
use tandem_kinematics::{
    ArmModel, ArmSample, CheckSettings, JACO_6, Joints, Limits, MICO_4, MICO_6, Motion, PlacedArm,
    Reason, Refusal, TaskFrame, WorkCell, check,
};

/// Postures and motions of the Mico with four joints, and of the arms with six.
const N_POSTURES: [u32; 2] = [100_000, 20_000];
const N_MOTIONS: [u32; 2] = [200, 50];
const PERIOD_S: f64 = 0.01;
const MARGIN_M: f64 = 0.005;
/// What the check states to hide between its looks, and what the distances below leave to rounding.
const TOLERANCE_M: f64 = 1e-4;
const ROUNDING_M: f64 = 1e-5;

/// Origin, metres, and roll, pitch, yaw of each joint's frame in the frame before, as Kinova's description has them.
type Table = &'static [([f64; 3], [f64; 3])];

static MICO_4_TABLE: Table = &[
    ([0.0, 0.0, 0.15675], [0.0, PI, 0.0]),
    ([0.0, 0.0016, -0.11875], [-FRAC_PI_2, 0.0, PI]),
    ([0.0, -0.290, 0.0], [0.0, PI, 0.0]),
    ([0.0, 0.1231, -0.0086], [-FRAC_PI_2, 0.0, PI]),
];
static MICO_6_TABLE: Table = &[
    ([0.0, 0.0, 0.15675], [0.0, PI, 0.0]),
    ([0.0, 0.0016, -0.11875], [-FRAC_PI_2, 0.0, PI]),
    ([0.0, -0.290, 0.0], [0.0, PI, 0.0]),
    ([0.0, 0.1231, -0.0086], [-FRAC_PI_2, 0.0, PI]),
    ([0.0, -0.03703, -0.06414], [FRAC_PI_3, 0.0, PI]),
    ([0.0, -0.03703, -0.06414], [FRAC_PI_3, 0.0, PI]),
];
static JACO_6_TABLE: Table = &[
    ([0.0, 0.0, 0.15675], [0.0, PI, 0.0]),
    ([0.0, 0.0016, -0.11875], [-FRAC_PI_2, 0.0, PI]),
    ([0.0, -0.410, 0.0], [0.0, PI, 0.0]),
    ([0.0, 0.2073, -0.0114], [-FRAC_PI_2, 0.0, PI]),
    ([0.0, -0.03703, -0.06414], [FRAC_PI_3, 0.0, PI]),
    ([0.0, -0.03703, -0.06414], [FRAC_PI_3, 0.0, PI]),
];

/// An arm as this file knows it.
struct Own {
    model: &'static ArmModel,
    table: Table,
}

static ARMS: [Own; 3] = [
    Own { model: &MICO_4, table: MICO_4_TABLE },
    Own { model: &MICO_6, table: MICO_6_TABLE },
    Own { model: &JACO_6, table: JACO_6_TABLE },
];

/// A line that ends in two points, and a radius; metres.
type Bar = ([DVec3; 2], f64);

impl Own {
    /// The parts, base first, with the gripper open by `opening`.
    fn bars(&self, angles: &Joints, opening: f64) -> Vec<Bar> {
        let (mut origin, mut axes) = (DVec3::ZERO, DMat3::IDENTITY);
        let mut origins = vec![origin];
        for ((xyz, [roll, pitch, yaw]), angle) in self.table.iter().zip(angles.iter()) {
            origin += axes * DVec3::from(*xyz);
            axes = axes
                * DMat3::from_rotation_z(*yaw)
                * DMat3::from_rotation_y(*pitch)
                * DMat3::from_rotation_x(*roll)
                * DMat3::from_rotation_z(*angle);
            origins.push(origin);
        }
        let n = self.table.len();
        let mut bars = vec![
            ([origins[0], origins[2]], 0.060),
            ([origins[2], origins[3]], 0.050),
            ([origins[3], origins[4]], 0.045),
        ];
        bars.extend((4..n).map(|joint| ([origins[joint], origins[joint + 1]], 0.040)));
        bars.push(([origins[n], origins[n] - 0.10 * axes.z_axis], 0.045));
        // Fingers close along y of the last joint and point against its z axis.
        let fingers = origins[n] - 0.1685 * axes.z_axis;
        let aside = (0.0175 + 0.035 * opening) * axes.y_axis;
        bars.push(([fingers - aside, fingers + aside], 0.035));
        bars
    }

    /// The smallest gap between parts that can meet, metres.
    fn gap_m(&self, angles: &Joints, opening: f64) -> f64 {
        let bars = self.bars(angles, opening);
        let last = bars.len() - 1;
        let mut pairs: Vec<(usize, usize, f64)> = (2..=last).map(|part| (0, part, 0.0)).collect();
        match self.table.len() {
            // The hand's and the upper arm's actuators are 28.5 mm thinner than their capsules.
            4 => pairs.extend([(1, 3, 0.0285), (1, 4, 0.0)]),
            _ => pairs.extend([(1, 4, 0.0), (1, 5, 0.0), (1, 6, 0.0)]),
        }
        let gap = |(first, second, allowed)| bar_gap_m(&bars[first], &bars[second]) + allowed;
        pairs.into_iter().map(gap).fold(f64::INFINITY, f64::min)
    }
}

/// The gap of two bars from points on the first, two millimetres apart: 0.01 mm too much at most where bars touch.
fn bar_gap_m(first: &Bar, second: &Bar) -> f64 {
    let ([from, to], [start, end]) = (first.0, second.0);
    let along = end - start;
    let squared = along.length_squared().max(1e-18);
    let n = ((to - from).length() / 0.002).ceil().max(1.0);
    let mut least = f64::INFINITY;
    let mut step = 0.0;
    while step <= n {
        let point = from + (to - from) * (step / n);
        let share = ((point - start).dot(along) / squared).clamp(0.0, 1.0);
        least = least.min((point - start - share * along).length_squared());
        step += 1.0;
    }
    least.sqrt() - first.1 - second.1
}

/// One arm with nothing round it, and a check that looks at nothing but speeds and the arm itself.
fn alone(model: &'static ArmModel) -> (WorkCell, CheckSettings) {
    let arm = PlacedArm { model, base_in_world_m: DVec3::new(0.3, -0.2, 0.0), yaw_rad: 0.7 };
    let cell = WorkCell { arms: vec![arm], table_z_m: -2.0, task_frame: TaskFrame::MICO_4 };
    let settings = CheckSettings {
        limits: Limits { tool_speed_mps: 10.0, ..Limits::default() },
        tilt_rad: PI,
        reach_share: 1.1,
        ..CheckSettings::default()
    };
    (cell, settings)
}

fn random_angles(model: &ArmModel, rng: &mut ChaCha8Rng) -> Joints {
    Joints::from_fn(model.n_joints(), |joint| {
        let [low, high] = model.joints[joint].range_rad;
        rng.random_range(low..high)
    })
}

/// Whether the check passes; it has nothing to refuse but the arm itself.
fn passes(checked: Result<(), Refusal>) -> Option<Refusal> {
    let refusal = checked.err()?;
    assert!(matches!(refusal.reason, Reason::SelfGap(..)), "{refusal}");
    Some(refusal)
}

#[test]
fn no_posture_in_which_an_arm_is_too_near_to_itself_is_accepted_and_no_other_is_refused() {
    for arm in &ARMS {
        let (cell, settings) = alone(arm.model);
        let mut rng = episode_rng(11, 0, Stream::Reset);
        let (mut n_refused, mut least_m) = (0, f64::INFINITY);
        let n_postures = N_POSTURES[usize::from(arm.table.len() > 4)];
        for _ in 0..n_postures {
            let angles = random_angles(arm.model, &mut rng);
            let opening = rng.random_range(0.0..1.0);
            let velocities = Joints::from_fn(angles.len(), |_| 0.0);
            let rest = ArmSample { angles, velocities, gripper_opening: opening };
            let motion = Motion { period_s: PERIOD_S, arms: vec![vec![rest; 2]] };
            let gap_m = arm.gap_m(&angles, opening);
            let same_m = arm.model.self_gap_m(&angles, opening);
            let near = (gap_m - same_m).abs() < ROUNDING_M || gap_m < -0.02;
            assert!(near, "{angles:?}, {opening}: {gap_m} {same_m}");
            if passes(check(&cell, &motion, &[angles], &settings)).is_some() {
                n_refused += 1;
                assert!(gap_m < MARGIN_M, "{angles:?}, {opening}: refused at {gap_m} m");
            } else {
                least_m = least_m.min(gap_m);
            }
        }
        println!(
            "{}: {n_refused} of {n_postures} refused, the others at {:.2} mm or more",
            arm.model.name,
            1e3 * least_m
        );
        assert!(least_m >= MARGIN_M - TOLERANCE_M - ROUNDING_M, "accepted at {least_m} m");
        assert!(n_refused > n_postures / 50 && n_refused < n_postures / 5);
    }
}

/// A motion from rest to rest between two random postures, as fast as joints may move.
fn random_motion(model: &ArmModel, rng: &mut ChaCha8Rng) -> Motion {
    let from = random_angles(model, rng);
    let to = Joints::from_fn(from.len(), |joint| {
        let [low, high] = model.joints[joint].range_rad;
        (from[joint] + rng.random_range(-1.2..1.2)).clamp(low, high)
    });
    let openings: [f64; 2] = [0; 2].map(|_| rng.random_range(0.0..1.0));
    let ramp_s = Limits::default().ramp_s;
    // The way s(u) = 10 u³ − 15 u⁴ + 6 u⁵ has a rate of 1.875 and an acceleration of 5.78 at most.
    let least_s = |joint: usize| {
        let (way, speed) = ((to[joint] - from[joint]).abs(), model.joints[joint].speed_radps);
        (1.9 * way / speed).max((6.5 * way * ramp_s / speed).sqrt())
    };
    let opens_s = 1.9 * (openings[1] - openings[0]).abs() / Limits::default().gripper_opening_per_s;
    let duration_s = (0..from.len()).map(least_s).fold(opens_s.max(0.1), f64::max);
    let n = (duration_s / PERIOD_S).ceil();
    let mut samples = Vec::new();
    let mut idx = 0.0;
    while idx <= n {
        let u: f64 = idx / n;
        let s = u * u * u * (10.0 + u * (6.0 * u - 15.0));
        let rate = 30.0 * u * u * (1.0 - u) * (1.0 - u) / (n * PERIOD_S);
        let angles = Joints::from_fn(from.len(), |j| from[j] + s * (to[j] - from[j]));
        let velocities = Joints::from_fn(from.len(), |j| rate * (to[j] - from[j]));
        let opening = openings[0] + s * (openings[1] - openings[0]);
        samples.push(ArmSample { angles, velocities, gripper_opening: opening });
        idx += 1.0;
    }
    Motion { period_s: PERIOD_S, arms: vec![samples] }
}

/// Times, seconds, and gaps, metres, a thousand times a second on the cubics between the samples.
fn gaps(arm: &Own, motion: &Motion) -> Vec<(f64, f64)> {
    let mut gaps = Vec::new();
    for (idx, ends) in motion.arms[0].windows(2).enumerate() {
        for tenth in 0..10 {
            let u = 0.1 * f64::from(tenth);
            let angles = Joints::from_fn(ends[0].angles.len(), |joint| {
                let (a, b) = (ends[0].angles[joint], ends[1].angles[joint]);
                let (da, db) = (ends[0].velocities[joint], ends[1].velocities[joint]);
                (1.0 + 2.0 * u) * (1.0 - u) * (1.0 - u) * a
                    + u * u * (3.0 - 2.0 * u) * b
                    + PERIOD_S * u * (1.0 - u) * ((1.0 - u) * da - u * db)
            });
            let opening =
                ends[0].gripper_opening + u * (ends[1].gripper_opening - ends[0].gripper_opening);
            gaps.push(((idx as f64 + u) * PERIOD_S, arm.gap_m(&angles, opening)));
        }
    }
    gaps
}

#[test]
fn no_motion_that_leads_an_arm_into_itself_between_its_samples_is_accepted() {
    for arm in &ARMS {
        let (cell, settings) = alone(arm.model);
        let mut rng = episode_rng(12, 0, Stream::Exploration);
        let (mut n_refused, mut least_m) = (0, f64::INFINITY);
        let n_motions = N_MOTIONS[usize::from(arm.table.len() > 4)];
        for number in 0..n_motions {
            let motion = random_motion(arm.model, &mut rng);
            let at = motion.arms[0][0].angles;
            let gaps = gaps(arm, &motion);
            let Some(refusal) = passes(check(&cell, &motion, &[at], &settings)) else {
                let least = gaps.iter().map(|(_, gap_m)| *gap_m).fold(f64::INFINITY, f64::min);
                least_m = least_m.min(least);
                continue;
            };
            n_refused += 1;
            assert_eq!(refusal.arm, ArmIndex(0));
            // Within an interval the gripper counts as wide as it is at the interval's wider end: 0.3 mm at most.
            let near = |(when_s, gap_m): &(f64, f64)| {
                (when_s - refusal.when_s).abs() <= PERIOD_S && *gap_m < MARGIN_M + 3e-4
            };
            assert!(gaps.iter().any(near), "{number}: {refusal}");
            let before = gaps.iter().filter(|(when_s, _)| *when_s < refusal.when_s - PERIOD_S);
            let earlier = before.map(|(_, gap_m)| *gap_m).fold(f64::INFINITY, f64::min);
            assert!(earlier >= MARGIN_M - TOLERANCE_M - ROUNDING_M, "{number}: {refusal}");
        }
        println!(
            "{}: {n_refused} of {n_motions} motions refused, the others at {:.2} mm or more",
            arm.model.name,
            1e3 * least_m
        );
        assert!(least_m >= MARGIN_M - TOLERANCE_M - ROUNDING_M, "accepted at {least_m} m");
        assert!(n_refused > n_motions / 20 && n_refused < n_motions / 2);
    }
}

#[test]
fn a_narrower_gripper_has_more_room() {
    let mut rng = episode_rng(13, 0, Stream::Reset);
    let mut n_let = 0;
    for _ in 0..20_000 {
        let angles = random_angles(&MICO_4, &mut rng);
        let [shut, half, open] = [0.0, 0.5, 1.0].map(|o| MICO_4.self_gap_m(&angles, o));
        assert!(shut >= half - 1e-12 && half >= open - 1e-12, "{angles:?}");
        n_let += u32::from(shut >= MARGIN_M && open < MARGIN_M);
    }
    assert!(n_let > 20, "{n_let}");
}

#[test]
fn solutions_in_which_the_arm_meets_itself_come_last() {
    let mut rng = episode_rng(14, 0, Stream::Reset);
    let (mut n_avoided, mut n_followed) = (0, 0);
    for _ in 0..100_000 {
        let angles = random_angles(&MICO_4, &mut rng);
        let at_m = tandem_kinematics::ForwardKinematics::new(&MICO_4, &angles).tool().origin_m;
        let target = tandem_kinematics::ToolTarget { at_m, yaw_rad: 0.0 };
        let near = random_angles(&MICO_4, &mut rng);
        let Ok(all) = MICO_4.solutions(&target, &near) else { continue };
        let taken = MICO_4.nearest(&target, &near).expect("one of these").angles;
        let clear = |q: &Joints| MICO_4.self_gap_m(q, 1.0) >= MARGIN_M;
        let any = all.iter().any(|solution| clear(&solution.angles));
        let moves_on = taken.largest_difference(&near) <= 0.35;
        assert!(clear(&taken) || !any || moves_on, "{taken:?} from {near:?}");
        n_avoided += u32::from(clear(&taken) && all.iter().any(|s| !clear(&s.angles)));
        // An arm that moves on by a little keeps its elbow where it is.
        let beside = MICO_4.nearest(&target, &all[0].angles).expect("the same");
        assert!(beside.angles.largest_difference(&all[0].angles) < 1e-6);
        n_followed += u32::from(!clear(&all[0].angles));
    }
    // Most places that one solution cannot reach clear of the base are in the way of all of them.
    assert!(n_avoided > 10 && n_followed > 500, "{n_avoided} {n_followed}");
}
