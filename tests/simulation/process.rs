//! Runs each simulation in its own deterministic process: random numbers come from the simulation's seed and clocks
//! show simulated time. Per-process state, such as the runtime counter from which tokio derives its random numbers, is
//! then the same in every repetition.

use std::fmt;
use std::path::Path;
use std::process::Command;
use std::str::FromStr;

use serde::{Deserialize, Serialize};
use tempfile::TempDir;

use crate::cluster::{Outcome, Statistics};
use crate::{system, trace};

/// Environment variable that names the simulation to run.
const SIMULATION: &str = "TANDEM_SIMULATION";
/// Environment variable that names the trace file.
const TRACE: &str = "TANDEM_SIM_TRACE";
/// The test that runs a simulation.
const TEST: &str = "one_simulation";
/// Prefix of the report in a process's output.
const REPORT: &str = "report of the simulation: ";

/// The kind of a simulation.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Kind {
    /// A run without faults. The number selects the run.
    Undisturbed,
    /// A run without faults and with an idle client.
    Silent,
    /// A run under faults. The number is the seed.
    Run,
    /// [`Self::Run`] with a ledger that forgets its verdicts.
    ForgetfulRun,
    /// A teacher with many clients, under faults. The number is the seed.
    Crowd,
    /// [`Self::Crowd`] with a ledger that forgets its verdicts.
    ForgetfulCrowd,
}

const NAMES: [(Kind, &str); 6] = [
    (Kind::Undisturbed, "undisturbed"),
    (Kind::Silent, "silent"),
    (Kind::Run, "run"),
    (Kind::ForgetfulRun, "forgetful-run"),
    (Kind::Crowd, "crowd"),
    (Kind::ForgetfulCrowd, "forgetful-crowd"),
];

/// A simulation, written `KIND:NUMBER`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Simulation(pub(crate) Kind, pub(crate) u64);

impl fmt::Display for Simulation {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let name = NAMES.iter().find(|(kind, _)| *kind == self.0).map_or("", |(_, name)| name);
        write!(formatter, "{name}:{}", self.1)
    }
}

impl FromStr for Simulation {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let parse = || {
            let (name, number) = text.split_once(':')?;
            let (kind, _) = NAMES.iter().find(|(_, known)| *known == name)?;
            Some(Self(*kind, number.parse().ok()?))
        };
        parse().ok_or_else(|| format!("not a simulation: {text:?}"))
    }
}

/// The result of a simulation.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Report {
    /// The outcome of the run. `None` for crowds.
    pub(crate) outcome: Option<Outcome>,
    pub(crate) statistics: Statistics,
}

/// Runs `simulation` in a separate process, which optionally writes its trace to `trace`. Returns the report, or the
/// first violation.
pub(crate) fn run(simulation: Simulation, trace: Option<&Path>) -> Result<Report, String> {
    let program = std::env::current_exe().expect("a test has a file");
    let mut command = Command::new(program);
    command
        .args([TEST, "--exact", "--ignored", "--nocapture"])
        .env(SIMULATION, simulation.to_string());
    if let Some(path) = trace {
        command.env(TRACE, path);
    }
    let output = command.output().expect("the process starts");
    let printed = String::from_utf8_lossy(&output.stdout);
    let report = printed.lines().find_map(|line| Some(line.split_once(REPORT)?.1));
    match report.map(serde_json::from_str::<Result<Report, String>>) {
        Some(Ok(report)) => report.map_err(|what| format!("{simulation}: {what}")),
        _ => {
            let errors = String::from_utf8_lossy(&output.stderr);
            Err(format!("{simulation}: {}, no report\n{printed}{errors}", output.status))
        }
    }
}

/// Runs the simulation that the environment requests, with `simulate`, and returns the report to print. Returns `None`
/// if none is requested.
pub(crate) fn run_requested(simulate: fn(Simulation) -> Result<Report, String>) -> Option<String> {
    #[expect(clippy::disallowed_methods, reason = "the parent process names the simulation")]
    let (requested, trace_path) = (std::env::var(SIMULATION), std::env::var(TRACE));
    let requested = requested.ok()?;
    let simulation: Simulation = requested.parse().expect(SIMULATION);
    if let Ok(path) = trace_path {
        trace::write_to(Path::new(&path));
    }
    // Files have relative names, which are the same in every repetition.
    let disk = TempDir::new().expect("a directory");
    std::env::set_current_dir(disk.path()).expect("a directory");
    // A thread draws random numbers for its first hash map. This thread may have done so already.
    let thread = std::thread::spawn(move || {
        system::simulate(simulation.1);
        simulate(simulation)
    });
    let report = thread.join().unwrap_or_else(|_panic| Err("a panic, see above".to_owned()));
    let report = serde_json::to_string(&report).expect("serializable");
    Some(format!("\n{REPORT}{report}"))
}
