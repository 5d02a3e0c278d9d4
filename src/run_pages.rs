//! The curve and the report that a run leaves in its directory.

use std::path::{Path, PathBuf};

use tandem_core::text::counted;
use tandem_report::{Axis, CurveOptions, FilmStrip, Quantity, Series};
use tandem_rl::RunConfig;
use tandem_system::atomic_file;
use tandem_telemetry::{MetricsLog, MetricsRow};

use crate::exit::{Exit, Failed, OrExit as _};

/// Files written at the end of a run.
pub(crate) struct RunPages {
    pub(crate) curve: PathBuf,
    pub(crate) report: PathBuf,
}

impl RunPages {
    /// Writes curve and report of the run in `out`, with the film strips `films`.
    pub(crate) fn write(
        config: &RunConfig,
        out: &Path,
        films: &[FilmStrip],
    ) -> Result<Self, Failed> {
        Self::of_rows(config, out, &read_rows(out)?, films)
    }

    /// Writes curve and report if the run has evaluations, for a run that ends early or without its supervisor.
    pub(crate) fn write_if_evaluated(
        config: &RunConfig,
        out: &Path,
    ) -> Result<Option<Self>, Failed> {
        if !metrics(out).exists() {
            return Ok(None);
        }
        let rows = read_rows(out)?;
        if rows.is_empty() { Ok(None) } else { Self::of_rows(config, out, &rows, &[]).map(Some) }
    }

    fn of_rows(
        config: &RunConfig,
        out: &Path,
        rows: &[MetricsRow],
        films: &[FilmStrip],
    ) -> Result<Self, Failed> {
        Ok(Self {
            curve: draw_curve(config, out, rows)?,
            report: tandem_report::run_report_html(out, films).or_cannot_write(String::new)?,
        })
    }
}

fn metrics(out: &Path) -> PathBuf {
    out.join("metrics.jsonl")
}

fn read_rows(out: &Path) -> Result<Vec<MetricsRow>, Failed> {
    MetricsLog::read_all(&metrics(out)).or_exit(Exit::Data, String::new)
}

/// Draws the success rate over environment steps.
fn draw_curve(config: &RunConfig, out: &Path, rows: &[MetricsRow]) -> Result<PathBuf, Failed> {
    let arms = counted(config.arms, "arm");
    let name = format!("{}, {arms}, {}", config.task, config.advice.strategy);
    let series = Series::of(&name, rows, Axis::EnvSteps, Quantity::Success);
    let title = format!("Success of the policy alone: {name}");
    let options = CurveOptions::of(&title, Quantity::Success, Axis::EnvSteps);
    let svg = tandem_report::curve_svg(&[series], &options).or_exit(Exit::Bug, String::new)?;
    let path = out.join("curve.svg");
    let written = atomic_file::replace(&path, svg.as_bytes());
    written.or_cannot_write(|| format!("cannot write {}", path.display()))?;
    Ok(path)
}
