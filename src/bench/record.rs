//! The cost of recording every episode of a run.

use std::path::Path;

use tandem_bench::Figure;
use tandem_system::process::ended_children_s;

use super::short_run;
use crate::exit::Failed;

/// Pairs of runs. Their order alternates, so a machine that slows down meanwhile favours neither.
const N_PAIRS: usize = 2;
/// Recipes, and the environment steps of a run of each. Recipe `paper` makes the fewest updates per step, so recording
/// has its largest share of the run.
const RECIPES: [(&str, &str); 2] = [("tandem", "4000"), ("paper", "16000")];

/// The cost of one run.
#[derive(Debug, Clone, Copy, Default)]
struct RunCost {
    wall_s: f64,
    /// Processor time of all its processes, seconds.
    processor_s: f64,
    env_steps: f64,
    n_logs: f64,
    log_bytes: f64,
}

/// Measures short runs that record every episode, and runs that record none.
pub(super) fn record() -> Result<Vec<Figure>, Failed> {
    let figures: Vec<_> =
        RECIPES.iter().map(|recipe| figures_of(*recipe)).collect::<Result<_, _>>()?;
    Ok(figures.concat())
}

fn figures_of((recipe, env_steps): (&str, &str)) -> Result<Vec<Figure>, Failed> {
    let (mut without, mut with) = (RunCost::default(), RunCost::default());
    for pair in 0..N_PAIRS {
        let mut order = [("none", &mut without), ("all", &mut with)];
        if pair % 2 == 1 {
            order.reverse();
        }
        for (recorded, total) in order {
            let options = ["--recipe", recipe, "--max-env-steps", env_steps, "--record", recorded];
            total.add(run(&options)?);
        }
    }
    let steps_per_s = |cost: RunCost| cost.env_steps / cost.wall_s;
    let steps_per_processor_s = |cost: RunCost| cost.env_steps / cost.processor_s;
    let processor_ratio = steps_per_processor_s(with) / steps_per_processor_s(without);
    let kb_per_log = with.log_bytes / with.n_logs / 1e3;
    let figure =
        |name: &str, value, unit| Figure::new(format!("record/{recipe}/{name}"), value, unit);
    Ok(vec![
        figure("none", steps_per_s(without), "env steps/s"),
        figure("all", steps_per_s(with), "env steps/s"),
        figure("ratio", steps_per_s(with) / steps_per_s(without), "all / none"),
        figure("processor-ratio", processor_ratio, "env steps per processor second, all / none"),
        figure("processor-time", with.extra_ms_per_episode(without), "ms per recorded episode"),
        figure("log-size", kb_per_log, "kB per recorded episode"),
    ])
}

impl RunCost {
    fn add(&mut self, run: Self) {
        self.wall_s += run.wall_s;
        self.processor_s += run.processor_s;
        self.env_steps += run.env_steps;
        self.n_logs += run.n_logs;
        self.log_bytes += run.log_bytes;
    }

    /// Returns the processor time that these runs took in addition to those `without` logs, per log.
    fn extra_ms_per_episode(self, without: Self) -> f64 {
        let scaled_s = without.processor_s * self.env_steps / without.env_steps;
        1e3 * (self.processor_s - scaled_s) / self.n_logs
    }
}

/// Measures one run with these options.
fn run(options: &[&str]) -> Result<RunCost, Failed> {
    let before_s = ended_children_s();
    let (summary, (n_logs, log_bytes)) =
        short_run(options, |directory| logs_in(&directory.join("mcap")))?;
    let number = |key: &str| summary[key].as_f64().unwrap_or_default();
    Ok(RunCost {
        wall_s: number("wall_s"),
        processor_s: ended_children_s() - before_s,
        env_steps: number("env_steps"),
        n_logs: n_logs as f64,
        log_bytes: log_bytes as f64,
    })
}

/// Returns the number and the size of the files in `directory`.
fn logs_in(directory: &Path) -> (u64, u64) {
    let sizes = std::fs::read_dir(directory).into_iter().flatten().flatten();
    let sizes = sizes.filter_map(|entry| Some(entry.metadata().ok()?.len()));
    sizes.fold((0, 0), |(n, bytes), n_bytes| (n + 1, bytes + n_bytes))
}
