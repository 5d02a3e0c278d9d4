//! Makes figures for people out of run directories: tables, curves, pictures of the scene, one HTML page.
//!
//! Reads what `tandem-telemetry` wrote and knows nothing of how runs are made.

pub mod curve;
mod error;
pub mod html;
pub mod measures;
pub mod run;
pub mod scene;
pub mod table;

pub use curve::{Axis, CurveOptions, CurvePoint, Quantity, Series, curve_svg};
pub use error::Error;
pub use html::{comparison_html, run_report_html};
pub use measures::LearningMeasures;
pub use run::Run;
pub use scene::{View, scene_svg};
pub use table::summary_table;
