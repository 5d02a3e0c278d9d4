//! Prints the smallest gaps between the parts of the Mico with four joints over its joints' ranges, by its capsules.
#![expect(clippy::print_stdout, reason = "its output")]

use tandem_core::rng::uniform;
use tandem_core::{Stream, episode_rng};
use tandem_kinematics::self_collision::SELF_GAP_M;
use tandem_kinematics::{Joints, MICO_4};

const N_CONFIGURATIONS: u32 = 1_000_000;
const OPENINGS: [f64; 3] = [1.0, 0.5, 0.0];

fn main() {
    println!("{}: {N_CONFIGURATIONS} configurations within the joints' ranges", MICO_4.name);
    println!("  pair                     least gap of capsules   with allowance   under 5 mm");
    for (idx, pair) in MICO_4.self_pairs.iter().enumerate() {
        let [first, second] = pair.links.map(|link| MICO_4.links[link].name);
        let (least_m, share) = least(idx);
        println!(
            "  {:<24} {:>15.1} mm {:>13.1} mm {:>10.2} %",
            format!("{first}, {second}"),
            1e3 * (least_m - pair.allowance_m),
            1e3 * least_m,
            share
        );
    }
    for opening in OPENINGS {
        let is_refused = |angles: &Joints| MICO_4.self_gap_m(angles, opening) < SELF_GAP_M;
        let share = percent(uniform_angles().filter(is_refused).count());
        println!("  refused with the gripper {:>3.0} % open: {share:.2} %", 100.0 * opening);
    }
}

/// Returns the smallest gap of a pair over the ranges, including its allowance, metres, and the share of uniformly
/// drawn configurations that are refused because of it, per cent.
fn least(pair: usize) -> (f64, f64) {
    let gap_m = |angles: Joints| MICO_4.pair_gap_m(pair, &angles, 1.0);
    let all = uniform_angles().chain(angles_at_ends());
    let least_m = all.map(gap_m).fold(f64::INFINITY, f64::min);
    let refused = uniform_angles().map(gap_m).filter(|gap_m| *gap_m < SELF_GAP_M);
    (least_m, percent(refused.count()))
}

/// Draws angles uniformly from the joints' ranges.
fn uniform_angles() -> impl Iterator<Item = Joints> {
    let mut rng = episode_rng(1, 0, Stream::Reset);
    (0..N_CONFIGURATIONS).map(move |_| {
        Joints::from_fn(MICO_4.n_joints(), |joint| {
            let [low, high] = MICO_4.joints[joint].range_rad;
            low + (high - low) * f64::from(uniform(&mut rng, 0.0, 1.0))
        })
    })
}

/// Draws the same angles with joints 2 and 3 at an end of their ranges.
fn angles_at_ends() -> impl Iterator<Item = Joints> {
    uniform_angles().map(|mut angles| {
        for joint in [1, 2] {
            let [low, high] = MICO_4.joints[joint].range_rad;
            angles[joint] = if angles[joint] < 0.5 * (low + high) { low } else { high };
        }
        angles
    })
}

/// Returns `count` in per cent of the configurations.
fn percent(count: usize) -> f64 {
    100.0 * count as f64 / f64::from(N_CONFIGURATIONS)
}
