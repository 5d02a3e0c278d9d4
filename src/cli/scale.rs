//! `tandem bench scale`: how many workers one learner holds.

use std::path::PathBuf;

use clap::Args;

#[derive(Debug, Clone, Args)]
#[command(next_help_heading = "Options of scale")]
pub(crate) struct ScaleArgs {
    /// Numbers of real worker processes; 0 for none.
    #[arg(
        long,
        value_name = "N,...",
        value_delimiter = ',',
        default_value = "1,2,4,8,16,32,64",
        value_parser = clap::value_parser!(u16).range(0..=1024)
    )]
    pub(crate) workers: Vec<u16>,
    /// Number of idle workers, which wait instead of simulating, all in this process; 0 for none.
    #[arg(long, value_name = "N", default_value_t = 1000, value_parser = clap::value_parser!(u16).range(0..=4096))]
    pub(crate) idle: u16,
    /// Number of rounds to measure for each setting.
    #[arg(long, value_name = "N", default_value_t = 4, value_parser = clap::value_parser!(u16).range(1..=1000))]
    pub(crate) rounds: u16,
    /// Number of idle workers that leave at once while as many join [default: a tenth of --idle].
    #[arg(long, value_name = "N")]
    pub(crate) join_leave: Option<u16>,
    /// Seconds that an idle worker takes for a slot; the default corresponds to 20 control steps per second.
    #[arg(long, value_name = "S", default_value_t = 2.5, value_parser = seconds_a_slot)]
    pub(crate) slot_s: f64,
    /// Updates per environment step; with 0 the learner makes one per round.
    #[arg(long, value_name = "R", default_value_t = 0.0)]
    pub(crate) updates_per_env_step: f64,
    /// Number of relays between the learner and the idle workers.
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = clap::value_parser!(u16).range(0..=64))]
    pub(crate) relays: u16,
    /// Other build of this program to measure [default: this one].
    #[arg(long, value_name = "FILE")]
    pub(crate) program: Option<PathBuf>,
}

/// A time from 10 milliseconds to 10 minutes.
fn seconds_a_slot(text: &str) -> Result<f64, String> {
    let seconds = text.parse::<f64>().ok().filter(|seconds| (0.01..=600.0).contains(seconds));
    seconds.ok_or_else(|| "expected seconds, 0.01 to 600".to_owned())
}
