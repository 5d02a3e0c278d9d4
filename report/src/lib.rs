//! Makes figures for people out of run directories and records of trials: tables, curves, pictures of the scene, HTML pages.
//!
//! Reads what `tandem-telemetry` wrote and knows nothing of how runs are made.

pub mod comparison;
pub mod curve;
mod error;
pub mod figures;
pub mod group;
pub mod held_out;
pub mod html;
pub mod measures;
pub mod paper;
pub mod records;
pub mod run;
pub mod scene;
pub mod table;
pub mod trials;

pub use comparison::{Baseline, Comparison, Section};
pub use curve::{Axis, CurveOptions, CurvePoint, Quantity, Series, curve_svg};
pub use error::Error;
pub use figures::Figure;
pub use group::{Group, Spread, Subject};
pub use held_out::HeldOut;
pub use html::{Written, report_html, run_report_html};
pub use measures::LearningMeasures;
pub use run::{Found, Run};
pub use scene::{View, scene_svg};
pub use table::Table;
pub use trials::{Pictured, TrialGroup, Trials, trial_svg};
