//! The check accepts no motion that leads an arm into itself, by forward kinematics and distances of this file's own.

use std::f64::consts::{FRAC_PI_2, FRAC_PI_3, PI, TAU};
use std::sync::LazyLock;

use nalgebra::{Isometry3, Point3, Rotation3, UnitQuaternion, Vector3};
use rand::RngExt as _;
use rand_chacha::ChaCha8Rng;
use tandem_core::{ArmIndex, Stream, episode_rng};
use tandem_kinematics::model::{Anchor, Joint, Link, SelfPair};
use tandem_kinematics::{
    ArmModel, ArmSample, CheckSettings, ForwardKinematics, Joints, Limits, MICO_4, Motion,
    PlacedArm, Reason, Refusal, TaskFrame, ToolTarget, WorkCell, check,
};

/// Configurations and motions of the arms with four and with six joints.
const N_CONFIGURATIONS: [u32; 2] = [100_000, 20_000];
const N_MOTIONS: [u32; 2] = [200, 50];
const PERIOD_S: f64 = 0.01;
const MARGIN_M: f64 = 0.005;
/// The stated tolerance of the check, and the rounding of the distances below.
const TOLERANCE_M: f64 = 1e-4;
const ROUNDING_M: f64 = 1e-5;

/// Origin (metres) and roll, pitch, yaw of each joint's frame in the previous frame, as in Kinova's description.
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

/// The Mico with six joints, `m1n6s200`: the check must hold for any number of joints. Pairs whose meshes never touch
/// according to Kinova's description for MoveIt are left out.
static MICO_6: LazyLock<ArmModel> = LazyLock::new(|| {
    let continuous = ([-TAU, TAU], true);
    let limited = |low: f64, high: f64| ([low.to_radians(), high.to_radians()], false);
    let ranges = [continuous, limited(50.0, 310.0), limited(35.0, 325.0)];
    let joint = |idx: usize, (xyz, [roll, pitch, yaw]): &([f64; 3], [f64; 3])| {
        let rotation = UnitQuaternion::from_euler_angles(*roll, *pitch, *yaw);
        let (range_rad, continuous) = *ranges.get(idx).unwrap_or(&continuous);
        Joint {
            previous_from_joint: Isometry3::from_parts(Vector3::from(*xyz).into(), rotation),
            range_rad,
            continuous,
            speed_radps: if idx < 3 { 36.0_f64 } else { 48.0 }.to_radians(),
        }
    };
    let joints = MICO_6_TABLE.iter().enumerate().map(|(idx, row)| joint(idx, row));
    let link = |name, ends, radius_m| Link { name, ends, radius_m, closed_share: 1.0 };
    let between = |from, to| [Anchor::origin_of(from), Anchor::origin_of(to)];
    let at = |x, z| Anchor { frame: 7, offset_m: Point3::new(x, 0.0, z) };
    let hand_end = Anchor { frame: 6, offset_m: Point3::new(0.0, 0.0, -0.10) };
    let links = [
        link("base", between(0, 2), 0.060),
        link("upper arm", between(2, 3), 0.050),
        link("forearm", between(3, 4), 0.045),
        link("wrist", between(4, 5), 0.040),
        link("wrist", between(5, 6), 0.040),
        link("hand", [Anchor::origin_of(6), hand_end], 0.045),
        Link {
            closed_share: 1.0 / 3.0,
            ..link("gripper", [at(-0.0525, 0.0085), at(0.0525, 0.0085)], 0.035)
        },
    ];
    let pairs = [[0, 2], [0, 3], [0, 4], [0, 5], [0, 6], [1, 4], [1, 5], [1, 6]];
    ArmModel {
        name: "m1n6s200",
        joints: joints.collect::<Vec<_>>().leak(),
        last_from_tool: MICO_4.last_from_tool,
        links: Vec::from(links).leak(),
        self_pairs: Vec::from(pairs.map(|links| SelfPair { links, allowance_m: 0.0 })).leak(),
        elbow_up_rad: &[-0.21, 2.51, 5.08, 2.97, 0.67, -0.38],
    }
});

/// An arm and this file's own description of it.
struct Own {
    model: &'static ArmModel,
    table: Table,
}

fn arms() -> [Own; 2] {
    [Own { model: &MICO_4, table: MICO_4_TABLE }, Own { model: &MICO_6, table: MICO_6_TABLE }]
}

/// The ends of a segment, and a radius; metres.
type Bar = ([Vector3<f64>; 2], f64);

impl Own {
    /// Returns the parts, base first, with the gripper open by `opening`.
    fn bars(&self, angles: &Joints, opening: f64) -> Vec<Bar> {
        let (mut origin, mut axes) = (Vector3::zeros(), Rotation3::identity());
        let mut origins = vec![origin];
        for ((xyz, [roll, pitch, yaw]), angle) in self.table.iter().zip(angles.iter()) {
            origin += axes * Vector3::from(*xyz);
            axes *= Rotation3::from_axis_angle(&Vector3::z_axis(), *yaw)
                * Rotation3::from_axis_angle(&Vector3::y_axis(), *pitch)
                * Rotation3::from_axis_angle(&Vector3::x_axis(), *roll)
                * Rotation3::from_axis_angle(&Vector3::z_axis(), *angle);
            origins.push(origin);
        }
        let n = self.table.len();
        let mut bars = vec![
            ([origins[0], origins[2]], 0.060),
            ([origins[2], origins[3]], 0.050),
            ([origins[3], origins[4]], 0.045),
        ];
        bars.extend((4..n).map(|joint| ([origins[joint], origins[joint + 1]], 0.040)));
        let (y_axis, z_axis) = (axes * Vector3::y(), axes * Vector3::z());
        bars.push(([origins[n], origins[n] - 0.10 * z_axis], 0.045));
        // The fingers close along y of the last joint and point against its z axis.
        let fingers = origins[n] - 0.1685 * z_axis;
        let aside = (0.0175 + 0.035 * opening) * y_axis;
        bars.push(([fingers - aside, fingers + aside], 0.035));
        bars
    }

    /// Returns the smallest gap between parts that can collide, metres.
    fn gap_m(&self, angles: &Joints, opening: f64) -> f64 {
        let bars = self.bars(angles, opening);
        let last = bars.len() - 1;
        let mut pairs: Vec<(usize, usize, f64)> = (2..=last).map(|part| (0, part, 0.0)).collect();
        match self.table.len() {
            // The actuators of hand and upper arm are 28.5 mm thinner than their capsules.
            4 => pairs.extend([(1, 3, 0.0285), (1, 4, 0.0)]),
            _ => pairs.extend([(1, 4, 0.0), (1, 5, 0.0), (1, 6, 0.0)]),
        }
        let gap = |(first, second, allowed)| bar_gap_m(&bars[first], &bars[second]) + allowed;
        pairs.into_iter().map(gap).fold(f64::INFINITY, f64::min)
    }
}

/// Returns the gap of two bars by sampling the first every two millimetres: at most 0.01 mm too large where bars touch.
fn bar_gap_m(first: &Bar, second: &Bar) -> f64 {
    let ([from, to], [start, end]) = (first.0, second.0);
    let along = end - start;
    let squared = along.norm_squared().max(1e-18);
    let n = ((to - from).norm() / 0.002).ceil().max(1.0);
    let mut least = f64::INFINITY;
    let mut step = 0.0;
    while step <= n {
        let point = from + (to - from) * (step / n);
        let share = ((point - start).dot(&along) / squared).clamp(0.0, 1.0);
        least = least.min((point - start - share * along).norm_squared());
        step += 1.0;
    }
    least.sqrt() - first.1 - second.1
}

/// Returns one arm with nothing around it, and a check of nothing but speeds and the arm itself.
fn alone(model: &'static ArmModel) -> (WorkCell, CheckSettings) {
    let arm = PlacedArm { model, base_in_world_m: Point3::new(0.3, -0.2, 0.0), yaw_rad: 0.7 };
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

/// Returns the refusal, if any. The check can refuse nothing but self-collisions.
fn self_refusal(checked: Result<(), Refusal>) -> Option<Refusal> {
    let refusal = checked.err()?;
    assert!(matches!(refusal.reason, Reason::SelfGap(..)), "{refusal}");
    Some(refusal)
}

#[test]
fn a_configuration_is_refused_if_and_only_if_the_arm_is_too_close_to_itself() {
    for arm in &arms() {
        let (cell, settings) = alone(arm.model);
        let mut rng = episode_rng(11, 0, Stream::Reset);
        let (mut n_refused, mut least_m) = (0, f64::INFINITY);
        let n_configurations = N_CONFIGURATIONS[usize::from(arm.table.len() > 4)];
        for _ in 0..n_configurations {
            let angles = random_angles(arm.model, &mut rng);
            let opening = rng.random_range(0.0..1.0);
            let velocities = Joints::from_fn(angles.len(), |_| 0.0);
            let rest = ArmSample { angles, velocities, gripper_opening: opening };
            let motion = Motion { period_s: PERIOD_S, arms: vec![vec![rest; 2]] };
            let gap_m = arm.gap_m(&angles, opening);
            let same_m = arm.model.self_gap_m(&angles, opening);
            let near = (gap_m - same_m).abs() < ROUNDING_M || gap_m < -0.02;
            assert!(near, "{angles:?}, {opening}: {gap_m} {same_m}");
            if self_refusal(check(&cell, &motion, &[angles], &settings)).is_some() {
                n_refused += 1;
                assert!(gap_m < MARGIN_M, "{angles:?}, {opening}: refused at {gap_m} m");
            } else {
                least_m = least_m.min(gap_m);
            }
        }
        println!(
            "{}: {n_refused} of {n_configurations} refused, the others at {:.2} mm or more",
            arm.model.name,
            1e3 * least_m
        );
        assert!(least_m >= MARGIN_M - TOLERANCE_M - ROUNDING_M, "accepted at {least_m} m");
        assert!(n_refused > n_configurations / 50 && n_refused < n_configurations / 5);
    }
}

/// Returns a motion from rest to rest between two random configurations, as fast as joints may move.
fn random_motion(model: &ArmModel, rng: &mut ChaCha8Rng) -> Motion {
    let from = random_angles(model, rng);
    let to = Joints::from_fn(from.len(), |joint| {
        let [low, high] = model.joints[joint].range_rad;
        (from[joint] + rng.random_range(-1.2..1.2)).clamp(low, high)
    });
    let openings: [f64; 2] = [0; 2].map(|_| rng.random_range(0.0..1.0));
    let ramp_s = Limits::default().ramp_s;
    // The profile s(u) = 10 u³ − 15 u⁴ + 6 u⁵ has a velocity of 1.875 and an acceleration of 5.78 at most.
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

/// Returns times (seconds) and gaps (metres), a thousand per second, on the cubics between the samples.
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
fn a_motion_that_leads_an_arm_into_itself_between_samples_is_refused() {
    for arm in &arms() {
        let (cell, settings) = alone(arm.model);
        let mut rng = episode_rng(12, 0, Stream::Exploration);
        let (mut n_refused, mut least_m) = (0, f64::INFINITY);
        let n_motions = N_MOTIONS[usize::from(arm.table.len() > 4)];
        for number in 0..n_motions {
            let motion = random_motion(arm.model, &mut rng);
            let at = motion.arms[0][0].angles;
            let gaps = gaps(arm, &motion);
            let Some(refusal) = self_refusal(check(&cell, &motion, &[at], &settings)) else {
                let least = gaps.iter().map(|(_, gap_m)| *gap_m).fold(f64::INFINITY, f64::min);
                least_m = least_m.min(least);
                continue;
            };
            n_refused += 1;
            assert_eq!(refusal.arm, ArmIndex(0));
            // Within an interval the gripper counts as wide as at the interval's wider end: 0.3 mm at most.
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
        let [closed, half, open] = [0.0, 0.5, 1.0].map(|o| MICO_4.self_gap_m(&angles, o));
        assert!(closed >= half - 1e-12 && half >= open - 1e-12, "{angles:?}");
        n_let += u32::from(closed >= MARGIN_M && open < MARGIN_M);
    }
    assert!(n_let > 20, "{n_let}");
}

#[test]
fn solutions_in_which_the_arm_collides_with_itself_come_last() {
    let mut rng = episode_rng(14, 0, Stream::Reset);
    let (mut n_avoided, mut n_followed) = (0, 0);
    for _ in 0..100_000 {
        let angles = random_angles(&MICO_4, &mut rng);
        let position_m = ForwardKinematics::new(&MICO_4, &angles).tool_m();
        let target = ToolTarget { position_m, yaw_rad: 0.0 };
        let seed = random_angles(&MICO_4, &mut rng);
        let Ok(all) = MICO_4.solutions(&target, &seed) else { continue };
        let taken = MICO_4.inverse_kinematics(&target, &seed).expect("one of these").angles;
        let clear = |q: &Joints| MICO_4.self_gap_m(q, 1.0) >= MARGIN_M;
        let any = all.iter().any(|solution| clear(&solution.angles));
        let continues = taken.largest_difference(&seed) <= 0.35;
        assert!(clear(&taken) || !any || continues, "{taken:?} from {seed:?}");
        n_avoided += u32::from(clear(&taken) && all.iter().any(|s| !clear(&s.angles)));
        // An arm that continues a motion keeps its elbow on the same side.
        let again = MICO_4.inverse_kinematics(&target, &all[0].angles).expect("the same");
        assert!(again.angles.largest_difference(&all[0].angles) < 1e-6);
        n_followed += u32::from(!clear(&all[0].angles));
    }
    // Where one solution collides with the base, usually all of them do.
    assert!(n_avoided > 10 && n_followed > 500, "{n_avoided} {n_followed}");
}
