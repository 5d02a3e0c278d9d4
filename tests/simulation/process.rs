//! Each simulation has a process of its own, in which nothing depends on chance: random numbers come from the
//! simulation's seed and clocks show simulated time. What a process has only once, like the count of runtimes from which
//! tokio derives its random numbers, is then the same whenever a simulation is repeated.

use std::fmt;
use std::path::Path;
use std::process::Command;
use std::str::FromStr;

use serde::{Deserialize, Serialize};
use tempfile::TempDir;

use crate::cluster::{Course, Outcome};
use crate::{system, trace};

/// Names the simulation that a process is to run.
const SIMULATION: &str = "TANDEM_SIMULATION";
/// Names the file for its trace.
const TRACE: &str = "TANDEM_SIM_TRACE";
/// The test that runs it.
const TEST: &str = "one_simulation";
/// Stands before the report in what a process prints.
const REPORT: &str = "report of the simulation: ";

/// What can be simulated.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Kind {
    /// A run without trouble; the number picks the run.
    Calm,
    /// A run without trouble and with somebody who is connected and says nothing.
    Silent,
    /// A run in trouble; the number is the seed.
    Run,
    /// [`Self::Run`] with a ledger that forgets its verdicts.
    ForgetfulRun,
    /// A teacher that many ask, in trouble; the number is the seed.
    Crowd,
    /// [`Self::Crowd`] with a ledger that forgets its verdicts.
    ForgetfulCrowd,
}

const NAMES: [(Kind, &str); 6] = [
    (Kind::Calm, "calm"),
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

/// What came out of a simulation.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Report {
    /// How the run ended, when one was simulated.
    pub(crate) outcome: Option<Outcome>,
    pub(crate) course: Course,
}

/// Runs `simulation` in a process of its own, and writes its trace to `trace` if need be; gives what came out, or what
/// went wrong that must not.
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
            let complaints = String::from_utf8_lossy(&output.stderr);
            Err(format!("{simulation}: {}, no report\n{printed}{complaints}", output.status))
        }
    }
}

/// Runs the simulation that this process was started for, by `simulate`, and gives the report that is to be printed;
/// `None` when it was not started for one.
pub(crate) fn run_the_one_asked_for(
    simulate: fn(Simulation) -> Result<Report, String>,
) -> Option<String> {
    #[expect(clippy::disallowed_methods, reason = "who starts the process says what for")]
    let (asked, traced) = (std::env::var(SIMULATION), std::env::var(TRACE));
    let asked = asked.ok()?;
    let simulation: Simulation = asked.parse().expect(SIMULATION);
    if let Ok(path) = traced {
        trace::write_to(Path::new(&path));
    }
    // Everything is written here, by names that are always the same.
    let disk = TempDir::new().expect("a directory");
    std::env::set_current_dir(disk.path()).expect("a directory");
    // A thread asks for random numbers when it first uses a hash map; this one may have.
    let thread = std::thread::spawn(move || {
        system::simulate(simulation.1);
        simulate(simulation)
    });
    let report = thread.join().unwrap_or_else(|_panic| Err("a panic, see above".to_owned()));
    let report = serde_json::to_string(&report).expect("is written as JSON");
    Some(format!("\n{REPORT}{report}"))
}
