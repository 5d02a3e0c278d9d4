//! Results of one setting, and their table.

use std::fmt;
use std::time::Duration;

use tandem_bench::{Calls, Figure, Percentiles};
use tandem_core::text::counted;
use tandem_system::process::{ProcessUsage, ResidentMemory, machine_busy_s};

use super::measures::{Bound, Load, knee, median_and_longest};

const MB: f64 = 1e6;

/// Results for one number of workers.
#[derive(Debug, Clone)]
pub(super) struct Row {
    pub(super) name: String,
    pub(super) n_workers: usize,
    pub(super) rounds_per_s: f64,
    pub(super) env_steps_per_s: f64,
    pub(super) in_bytes_per_s: f64,
    pub(super) out_bytes_per_s: f64,
    pub(super) load: Load,
    pub(super) resident_mib: f64,
    pub(super) peak_mib: f64,
    pub(super) median_round_s: f64,
    pub(super) longest_round_s: f64,
    /// Only for workers in this process.
    pub(super) calls: Option<Calls>,
}

/// Usage of the processes and of the machine at one moment.
pub(super) struct Reading {
    at: Duration,
    learner: ProcessUsage,
    workers: ProcessUsage,
    machine_s: f64,
}

impl Reading {
    pub(super) fn take(at: Duration, learner: u32, workers: &[u32]) -> Self {
        let (learner, workers) = (ProcessUsage::of(learner), ProcessUsage::of_all(workers));
        Self { at, learner, workers, machine_s: machine_busy_s() }
    }
}

/// The measured rounds.
pub(super) struct Rounds {
    pub(super) env_steps: usize,
    /// The start of each round, from the first one to the one after the last.
    pub(super) starts: Vec<Duration>,
}

impl Row {
    /// Computes the results between two readings.
    pub(super) fn between(
        (before, after): (&Reading, &Reading),
        (name, n_workers): (String, usize),
        rounds: &Rounds,
        learner: u32,
    ) -> Self {
        let span_s = (after.at - before.at).as_secs_f64().max(1e-9);
        let (spent, of_workers) =
            (after.learner.since(before.learner), after.workers.since(before.workers));
        let n_cores = std::thread::available_parallelism().map_or(1, std::num::NonZero::get) as f64;
        let starts = &rounds.starts;
        let rounds_s = match (starts.first(), starts.last()) {
            (Some(first), Some(last)) if last > first => (*last - *first).as_secs_f64(),
            _ => f64::INFINITY,
        };
        let rounds_per_s = starts.len().saturating_sub(1) as f64 / rounds_s;
        let (median, longest) = median_and_longest(starts).unwrap_or_default();
        let memory = ResidentMemory::of(learner);
        Self {
            name,
            n_workers,
            rounds_per_s,
            env_steps_per_s: rounds_per_s * rounds.env_steps as f64,
            in_bytes_per_s: of_workers.written_bytes / span_s,
            out_bytes_per_s: spent.written_bytes / span_s,
            load: Load {
                serving: spent.first_thread_s / span_s,
                learning: (spent.cpu_s - spent.first_thread_s) / span_s,
                workers: of_workers.cpu_s / span_s,
                machine: (after.machine_s - before.machine_s) / span_s,
                n_cores,
            },
            resident_mib: memory.current_kib as f64 / 1024.0,
            peak_mib: memory.peak_kib as f64 / 1024.0,
            median_round_s: median.as_secs_f64(),
            longest_round_s: longest.as_secs_f64(),
            calls: None,
        }
    }

    fn figures(&self) -> Vec<Figure> {
        let figure = |what: &str, value, unit| {
            Figure::new(format!("scale/{}/{what}", self.name), value, unit)
        };
        let mut figures = vec![
            figure("rounds", self.rounds_per_s, "rounds/s"),
            figure("env-steps", self.env_steps_per_s, "env steps/s"),
            figure("received", self.in_bytes_per_s / MB, "MB/s"),
            figure("sent", self.out_bytes_per_s / MB, "MB/s"),
            figure("learner-serving", self.load.serving, "cores"),
            figure("learner-learning", self.load.learning, "cores"),
            figure("workers", self.load.workers, "cores"),
            figure("machine", self.load.machine, "cores"),
            figure("learner-memory", self.resident_mib, "MiB"),
            figure("learner-peak-memory", self.peak_mib, "MiB"),
            figure("median-round", self.median_round_s, "s"),
            figure("longest-round", self.longest_round_s, "s"),
        ];
        if let Some(calls) = &self.calls {
            for (what, Percentiles { p50, p99 }) in [
                ("assignment", calls.assignment),
                ("parameters", calls.parameters),
                ("delivery", calls.delivery),
            ] {
                figures.push(figure(&format!("{what}/p50"), millis(p50), "ms"));
                figures.push(figure(&format!("{what}/p99"), millis(p99), "ms"));
            }
            figures.push(figure("failed-calls", calls.n_failed as f64, "calls"));
            figures.push(figure("covered-slots", calls.n_reassigned as f64, "slots"));
        }
        figures
    }
}

fn millis(time: Duration) -> f64 {
    1e3 * time.as_secs_f64()
}

/// All results.
#[derive(Debug, Default)]
pub(in crate::bench) struct Scale {
    pub(super) real: Vec<Row>,
    pub(super) idle: Vec<Row>,
    /// Seconds until all idle workers had joined.
    pub(super) joined_s: Option<f64>,
}

impl Scale {
    /// Returns the number of workers beyond which throughput saturates, and the bottleneck there.
    fn knee(&self) -> Option<(usize, Bound)> {
        let points: Vec<_> =
            self.real.iter().map(|row| (row.n_workers, row.env_steps_per_s)).collect();
        let idx = knee(&points)?;
        Some((self.real[idx].n_workers, Bound::of(&self.real[idx + 1].load)))
    }

    pub(in crate::bench) fn figures(&self) -> Vec<Figure> {
        let mut figures: Vec<Figure> =
            self.real.iter().chain(&self.idle).flat_map(Row::figures).collect();
        if let Some(seconds) = self.joined_s {
            figures.push(Figure::new("scale/all-joined", seconds, "s"));
        }
        if let Some((n_workers, bound)) = self.knee() {
            figures.push(Figure::new("scale/knee", n_workers as f64, bound.text()));
        }
        figures
    }
}

impl fmt::Display for Scale {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let rows = self.real.iter().chain(&self.idle);
        let width = rows.clone().map(|row| row.name.len()).max().unwrap_or(0);
        writeln!(
            out,
            "{:width$}  rounds/s  env steps/s  MB/s in  MB/s out  serving  learning  workers  machine  MiB now  MiB peak  median round  longest",
            ""
        )?;
        for row in rows {
            write!(out, "{:width$}", row.name)?;
            write!(out, "{:10.2}{:13.0}", row.rounds_per_s, row.env_steps_per_s)?;
            write!(out, "{:9.2}{:10.1}", row.in_bytes_per_s / MB, row.out_bytes_per_s / MB)?;
            let Load { serving, learning, workers, machine, .. } = row.load;
            write!(out, "{serving:9.2}{learning:10.2}{workers:9.2}{machine:9.2}")?;
            write!(out, "{:9.0}{:10.0}", row.resident_mib, row.peak_mib)?;
            writeln!(out, "{:12.2} s{:7.2} s", row.median_round_s, row.longest_round_s)?;
        }
        writeln!(out, "serving to machine: cores that were busy\n")?;
        for row in &self.idle {
            let Some(calls) = &row.calls else { continue };
            write!(out, "{}: ", row.name)?;
            for (what, Percentiles { p50, p99 }) in [
                ("assignment", calls.assignment),
                ("parameters", calls.parameters),
                ("delivery", calls.delivery),
            ] {
                write!(out, "{what} p50 {:.1} p99 {:.1} ms, ", millis(p50), millis(p99))?;
            }
            writeln!(out, "{} calls failed, {} slots covered", calls.n_failed, calls.n_reassigned)?;
        }
        if let Some(seconds) = self.joined_s {
            writeln!(out, "all idle workers had joined after {seconds:.2} s")?;
        }
        match self.knee() {
            Some((n_workers, bound)) => {
                writeln!(out, "knee: {}; {}", counted(n_workers, "real worker"), bound.text())
            }
            None if self.real.len() > 1 => writeln!(out, "knee: not reached"),
            None => Ok(()),
        }
    }
}
