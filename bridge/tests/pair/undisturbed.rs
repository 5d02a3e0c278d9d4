//! Undisturbed motions are played to their ends along their paths.

use glam::DVec3;
use tandem_bridge::work_cell::mico_cell;
use tandem_trials::SimulatedConfig;

use crate::pair::observer::{Observer, Slack};
use crate::pair::rig::{Rig, TASKS, tools, walk};

const N_EXECUTIONS: usize = 60;
const N_EXECUTIONS_WITH_TIME: usize = 200;
/// The largest distance of the tools from their planned paths, metres.
const PATH_M: f64 = 0.004;

#[test]
fn random_motions_are_not_stopped() {
    execute_all(N_EXECUTIONS);
}

#[test]
#[ignore = "takes a quarter of a minute"]
fn two_hundred_random_motions_are_not_stopped() {
    execute_all(N_EXECUTIONS_WITH_TIME);
}

#[expect(clippy::print_stdout, reason = "measurements for --nocapture")]
fn execute_all(n_executions: usize) {
    let cell = mico_cell();
    let (mut worst_m, mut tool_share, mut arms_m, mut table_m) =
        (0.0_f64, 0.0_f64, f64::INFINITY, f64::INFINITY);
    let mut seconds = 0.0;
    for idx in 0..n_executions {
        let seed = idx as u64;
        let motion = walk(TASKS, seed, 4);
        let planned: Vec<Vec<DVec3>> = (0..motion.arms[0].len())
            .map(|idx| {
                let angles: Vec<_> =
                    motion.arms.iter().map(|samples| samples[idx].angles).collect();
                tools(&cell, &angles)
            })
            .collect();
        let speed = [1.0, 1.0, 0.6, 0.3][idx % 4];
        let mut rig = Rig::ready(&motion, SimulatedConfig { seed, ..SimulatedConfig::default() });
        let mut observer = Observer::new(Slack::NONE);
        let from_s = rig.now_s;
        rig.play(motion.clone(), speed, |rig| {
            observer.look(&rig.pair.borrow(), &format!("walk {seed}"));
            for (arm, tool_m) in tools(&cell, &rig.angles()).into_iter().enumerate() {
                let distances_m = planned.iter().map(|planned| (planned[arm] - tool_m).length());
                worst_m = worst_m.max(distances_m.fold(f64::INFINITY, f64::min));
            }
        });
        seconds += rig.now_s - from_s;
        let ends: Vec<_> = motion.arms.iter().map(|s| s[s.len() - 1].angles).collect();
        for (end, angles) in ends.iter().zip(rig.angles()) {
            assert!(end.largest_difference(&angles) < 0.3_f64.to_radians(), "walk {seed}");
        }
        tool_share = tool_share.max(observer.tool_share);
        arms_m = arms_m.min(observer.least_arms_gap_m);
        table_m = table_m.min(observer.least_table_gap_m);
    }
    println!(
        "{n_executions} walks, {seconds:.0} s: {:.1} mm off the path, {tool_share:.3} of the tool's speed, \
         gaps {:.1} mm and {:.1} mm",
        worst_m * 1e3,
        arms_m * 1e3,
        table_m * 1e3
    );
    assert!(worst_m < PATH_M, "{worst_m} m off the path");
}
