//! Reports on runs and trials: tables, curves and plots as text, SVG and HTML, and exports as JSON and CSV.
//!
//! The crate reads the files that `tandem-telemetry` writes, and does not depend on how runs are made. A report is made
//! in three steps: [`ReportInputs::load`] reads runs and trials, [`Comparison::of`] and [`Trials::of`] group them, and
//! [`report_html`] writes the page and its plots. [`run_report_html`] writes the page of a single run.
//!
//! ```
//! use tandem_report::{Comparison, Run};
//! use tandem_telemetry::MetricsRow;
//!
//! let evaluation = MetricsRow { env_steps: 20_000, success: 0.75, n_episodes: 240, ..MetricsRow::default() };
//! let run = Run { name: "push-seed1".to_owned(), rows: vec![evaluation], ..Run::default() };
//! let comparison = Comparison::of(vec![run], Vec::new());
//! assert!(comparison.text().contains("0.750"), "the best evaluation");
//! ```
#![warn(missing_docs)]

mod bitmap;
mod color;
pub mod comparison;
pub mod curve;
mod error;
pub mod export;
mod files;
pub mod group;
mod html;
pub mod inputs;
pub mod measures;
pub mod pages;
pub mod paper;
pub mod plots;
pub mod quantity;
pub mod run;
pub mod run_summary;
pub mod spread;
pub mod table;
pub mod test_evaluation;
pub mod trials;

pub use comparison::{Baseline, Comparison, FilmStrip, Section};
pub use curve::{Axis, CurveOptions, CurvePoint, Series, curve_svg};
pub use error::Error;
pub use group::{SeedGroup, TaskSetup};
pub use inputs::ReportInputs;
pub use measures::LearningMeasures;
pub use pages::{ReportFiles, report_html, run_report_html};
pub use plots::Plot;
pub use quantity::Quantity;
pub use run::{Configuration, Run};
pub use run_summary::RunLength;
pub use spread::{MeanInterval, ShareSpread, Spread};
pub use table::Table;
pub use test_evaluation::TestEvaluation;
pub use trials::{PlottedTrials, TrialGroup, Trials, trial_svg};

/// Tests of the public interface, which name this crate as other crates do.
#[cfg(test)]
#[path = "../tests/report.rs"]
mod report_tests;
#[cfg(test)]
#[path = "../tests/trials.rs"]
mod trial_tests;
#[cfg(test)]
extern crate self as tandem_report;
