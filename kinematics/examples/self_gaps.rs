//! Prints how near the parts of each arm come to each other over the joints' ranges, by their capsules.
#![expect(clippy::print_stdout, reason = "its output")]

use tandem_core::rng::uniform;
use tandem_core::{Stream, episode_rng};
use tandem_kinematics::self_collision::SELF_GAP_M;
use tandem_kinematics::{ArmModel, JACO_6, Joints, MICO_4, MICO_6};

const N_POSTURES: u32 = 1_000_000;
const OPENINGS: [f64; 3] = [1.0, 0.5, 0.0];

fn main() {
    for model in [&MICO_4, &MICO_6, &JACO_6] {
        println!("{}: {N_POSTURES} postures within the joints' ranges", model.name);
        println!("  pair                     least gap of capsules   with allowance   under 5 mm");
        for (idx, pair) in model.self_pairs.iter().enumerate() {
            let [first, second] = pair.links.map(|link| model.links[link].name);
            let (least_m, share) = least(model, idx);
            println!(
                "  {:<24} {:>15.1} mm {:>13.1} mm {:>10.2} %",
                format!("{first}, {second}"),
                1e3 * (least_m - pair.allowance_m),
                1e3 * least_m,
                share
            );
        }
        for opening in OPENINGS {
            let near = |angles: &Joints| model.self_gap_m(angles, opening) < SELF_GAP_M;
            let share = share(even(model).filter(near).count());
            println!("  refused with the gripper {:>3.0} % open: {share:.2} %", 100.0 * opening);
        }
    }
}

/// The least gap of a pair with its allowance over the ranges, metres, and how often postures drawn evenly are nearer than
/// motions may be, per cent.
fn least(model: &ArmModel, pair: usize) -> (f64, f64) {
    let gap_m = |angles: Joints| model.pair_gap_m(pair, &angles, 1.0);
    let least_m = even(model).chain(at_ends(model)).map(gap_m).fold(f64::INFINITY, f64::min);
    (least_m, share(even(model).map(gap_m).filter(|gap_m| *gap_m < SELF_GAP_M).count()))
}

/// Angles drawn evenly from the joints' ranges.
fn even(model: &ArmModel) -> impl Iterator<Item = Joints> {
    let mut rng = episode_rng(1, 0, Stream::Reset);
    (0..N_POSTURES).map(move |_| {
        Joints::from_fn(model.n_joints(), |joint| {
            let [low, high] = model.joints[joint].range_rad;
            low + (high - low) * f64::from(uniform(&mut rng, 0.0, 1.0))
        })
    })
}

/// The same with joints 2 and 3 at an end of their ranges.
fn at_ends(model: &ArmModel) -> impl Iterator<Item = Joints> {
    even(model).map(|mut angles| {
        for joint in [1, 2] {
            let [low, high] = model.joints[joint].range_rad;
            angles[joint] = if angles[joint] < 0.5 * (low + high) { low } else { high };
        }
        angles
    })
}

/// Per cent of the postures.
fn share(count: usize) -> f64 {
    100.0 * count as f64 / f64::from(N_POSTURES)
}
