//! Options for recorded episodes.

use std::ffi::OsString;
use std::fmt;
use std::net::SocketAddr;
use std::str::FromStr;

use clap::{Args, ValueEnum};

/// Default size limit of the recorded episodes.
const DEFAULT_LOG_BUDGET: ByteSize = ByteSize(2 << 30);
/// Default address of the live view.
const DEFAULT_LIVE: &str = "127.0.0.1:8765";

/// Recording of episodes.
#[derive(Debug, Clone, Copy, Args)]
pub(crate) struct RecordingArgs {
    /// Episodes to record as MCAP files: none, evaluation (the first ones of each evaluation,
    /// evaluation.recorded_episodes) or all (these and every training episode).
    #[arg(long, value_enum, default_value_t = RecordedName::Evaluation, hide_possible_values = true)]
    pub(crate) record: RecordedName,
    /// Size that the recorded episodes may reach, for example 500MB or 10GiB. Beyond it, the oldest ones are deleted,
    /// training episodes first.
    #[arg(long, value_name = "SIZE", default_value_t = DEFAULT_LOG_BUDGET)]
    pub(crate) log_budget: ByteSize,
}

impl RecordingArgs {
    /// Returns the arguments for a child process.
    pub(crate) fn arguments(self) -> [OsString; 4] {
        let name = self
            .record
            .to_possible_value()
            .map_or_else(String::new, |value| value.get_name().to_owned());
        ["--record".into(), name.into(), "--log-budget".into(), self.log_budget.to_string().into()]
    }

    /// Returns the options that differ from their defaults, each after a space, for a command line that is printed.
    pub(crate) fn shell_words(self) -> String {
        let record = match self.record {
            RecordedName::None => " --record none",
            RecordedName::Evaluation => "",
            RecordedName::All => " --record all",
        };
        match self.log_budget {
            DEFAULT_LOG_BUDGET => record.to_owned(),
            budget => format!("{record} --log-budget {budget}"),
        }
    }
}

/// Live view in Foxglove.
#[derive(Debug, Clone, Copy, Default, Args)]
pub(crate) struct LiveArgs {
    /// Shows the episodes in Foxglove, over a websocket at this address [with no address: 127.0.0.1:8765]. Anyone who
    /// can reach the address can watch.
    #[arg(long, value_name = "ADDR", num_args = 0..=1, default_missing_value = DEFAULT_LIVE)]
    pub(crate) live: Option<SocketAddr>,
}

impl LiveArgs {
    /// Returns the option, after a space, for a command line that is printed.
    pub(crate) fn shell_words(self) -> String {
        match self.live.map(|address| address.to_string()) {
            None => String::new(),
            Some(address) if address == DEFAULT_LIVE => " --live".to_owned(),
            Some(address) => format!(" --live {address}"),
        }
    }
}

/// The episodes to record.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum RecordedName {
    None,
    Evaluation,
    All,
}

/// A number of bytes, with the units B, kB, MB, GB, TB, KiB, MiB, GiB and TiB.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct ByteSize(pub(crate) u64);

/// Units from small to large.
const UNITS: [(&str, u64); 9] = [
    ("B", 1),
    ("kB", 1_000),
    ("KiB", 1 << 10),
    ("MB", 1_000_000),
    ("MiB", 1 << 20),
    ("GB", 1_000_000_000),
    ("GiB", 1 << 30),
    ("TB", 1_000_000_000_000),
    ("TiB", 1 << 40),
];

impl FromStr for ByteSize {
    type Err = &'static str;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let digits = text.trim_end_matches(|c: char| c.is_ascii_alphabetic());
        let name = &text[digits.len()..];
        let unit = UNITS.iter().find(|(unit, _)| unit.eq_ignore_ascii_case(name));
        let number = digits.trim().parse::<u64>().ok();
        let bytes = number.zip(unit).and_then(|(number, (_, unit))| number.checked_mul(*unit));
        bytes.map(Self).ok_or("expected a whole number with a unit, for example 500MB or 10GiB")
    }
}

impl fmt::Display for ByteSize {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let fits = |(_, unit): &&(&str, u64)| self.0 >= *unit && self.0.is_multiple_of(*unit);
        let (name, unit) = UNITS.iter().rfind(fits).unwrap_or(&UNITS[0]);
        write!(formatter, "{}{name}", self.0 / unit)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_parsed_and_shown_in_their_largest_unit() {
        let check = |text: &str, bytes: u64, shown: &str| {
            let size: ByteSize = text.parse().unwrap();
            assert_eq!((size.0, size.to_string().as_str()), (bytes, shown), "{text}");
        };
        check("2GiB", 2 << 30, "2GiB");
        check("500 mb", 500_000_000, "500MB");
        check("1536KiB", 1536 << 10, "1536KiB");
        check("2048KiB", 2 << 20, "2MiB");
        check("0B", 0, "0B");
        for refused in ["2", "GiB", "1.5GiB", "-1MB", "2GiBs", "99999999999TiB", ""] {
            assert!(refused.parse::<ByteSize>().is_err(), "{refused:?}");
        }
    }
}
