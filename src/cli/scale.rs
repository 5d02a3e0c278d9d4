//! `tandem bench scale`: how many workers one learner holds.

use std::path::PathBuf;

use clap::Args;

#[derive(Debug, Clone, Args)]
#[command(next_help_heading = "Options of scale")]
pub(crate) struct ScaleArgs {
    /// Numbers of real worker processes to try; 0 tries none.
    #[arg(
        long,
        value_name = "N,...",
        value_delimiter = ',',
        default_value = "1,2,4,8,16,32,64",
        value_parser = clap::value_parser!(u16).range(0..=1024)
    )]
    pub(crate) workers: Vec<u16>,
    /// Workers that wait instead of simulating, all in this process; 0 tries none.
    #[arg(long, value_name = "N", default_value_t = 1000, value_parser = clap::value_parser!(u16).range(0..=4096))]
    pub(crate) idle: u16,
    /// Rounds measured of each setting.
    #[arg(long, value_name = "N", default_value_t = 4, value_parser = clap::value_parser!(u16).range(1..=1000))]
    pub(crate) rounds: u16,
    /// Idle workers that leave at once while as many join [default: a tenth of --idle].
    #[arg(long, value_name = "N")]
    pub(crate) join_leave: Option<u16>,
    /// Seconds that an idle worker takes for a slot, as one does that makes 20 control steps a second.
    #[arg(long, value_name = "S", default_value_t = 2.5, value_parser = seconds_a_slot)]
    pub(crate) slot_s: f64,
    /// Updates for each environment step; without any the learner makes one a round, the least it can.
    #[arg(long, value_name = "R", default_value_t = 0.0)]
    pub(crate) updates_per_env_step: f64,
    /// Relays between the learner and the idle workers.
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = clap::value_parser!(u16).range(0..=64))]
    pub(crate) relays: u16,
    /// Another build of this program whose learner, relays and workers are measured [default: this one].
    #[arg(long, value_name = "FILE")]
    pub(crate) program: Option<PathBuf>,
}

/// A time from 10 milliseconds to 10 minutes.
fn seconds_a_slot(text: &str) -> Result<f64, String> {
    let seconds = text.parse::<f64>().ok().filter(|seconds| (0.01..=600.0).contains(seconds));
    seconds.ok_or_else(|| "expected seconds, 0.01 to 600".to_owned())
}
