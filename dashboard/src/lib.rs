//! Live web pages: the dashboards of runs and sweeps, and the operator page of a bridge.
//!
//! A [`Site`] is a page and the data that it shows. [`Site::of_run`] makes one from snapshots of a run,
//! [`Site::of_sweep`] from those of a sweep, [`Site::of_bridge`] from states of arms; [`serve`] serves it to browsers.
//! Pages contain no reference to other servers, and receive changes as server-sent events.
//!
//! The crate knows snapshots only: where they come from, and what they cost, is decided by the caller. A snapshot is
//! encoded once for all viewers, and a viewer that does not keep up receives the newest one next.
//!
//! Reading order: `run` (from snapshots to documents) with `document`, `events` and `playback`, `sweep`, `bridge`,
//! `page` (HTML), `site` (routes), `access` (who may see a page), `server` (connections).
#![warn(missing_docs)]

mod access;
mod bridge;
mod document;
mod events;
mod page;
mod playback;
mod run;
mod server;
mod site;
mod sweep;

pub use access::Access;
pub use bridge::BridgeTerms;
pub use server::{MAX_VIEWERS, serve};
pub use site::{ConfirmedStop, Site, StopAction, StopResult};
pub use sweep::{RunPace, SweepResult, SweepRunState, SweepRunView, SweepView};
