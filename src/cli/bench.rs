//! The command line of `tandem bench`.

use std::path::PathBuf;

use clap::{Args, ValueEnum};

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  tandem bench  # all but record and scale, about two minutes
  tandem bench sim update --json
  tandem bench record
      # cost of recording every episode, some minutes
  tandem bench scale
      # number of workers that one learner serves, about two minutes
  tandem bench scale --workers 0 --idle 1000 --join-leave 100")]
pub(crate) struct BenchArgs {
    /// Benchmarks to run [default: all but record and scale].
    #[arg(value_enum)]
    pub(crate) what: Vec<BenchName>,
    /// Prints one JSON object per line: name, value, unit.
    #[arg(long)]
    pub(crate) json: bool,
    #[command(flatten)]
    pub(crate) scale: ScaleArgs,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum BenchName {
    /// Environment steps per second on one core.
    Sim,
    /// Time of one decision of the student.
    Inference,
    /// Updates per second, by the number of threads.
    Update,
    /// Time of sampling a batch with hindsight.
    Replay,
    /// The teacher service, compared with an echo service of the same messages.
    #[value(alias = "wire")]
    Teacher,
    /// A short training run with all its processes.
    EndToEnd,
    /// A short training run with and without a recording of every episode.
    Record,
    /// One learner with increasing numbers of workers, real and idle ones.
    Scale,
}

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

/// Parses a number of seconds from 0.01 to 600.
fn seconds_a_slot(text: &str) -> Result<f64, String> {
    let seconds = text.parse::<f64>().ok().filter(|seconds| (0.01..=600.0).contains(seconds));
    seconds.ok_or_else(|| "expected seconds, 0.01 to 600".to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_benchmark_of_the_teacher_has_a_second_name() {
        for name in ["teacher", "wire"] {
            assert_eq!(BenchName::from_str(name, false), Ok(BenchName::Teacher));
        }
    }
}
