//! The handle of an operator in the process of the service.

use std::sync::Arc;

use tandem_kinematics::WorkCell;
use tokio::sync::watch;

use crate::executor::{Settings, Stop};
use crate::service::error::Error;
use crate::service::snapshot::Snapshot;
use crate::service::thread::ArmsHandle;

/// Sees the arms and stops them, as clients do with `Status` and `Stop`.
#[derive(Clone)]
pub struct Operator(pub(super) ArmsHandle);

impl Operator {
    /// Returns the work cell of the arms.
    #[must_use]
    pub fn cell(&self) -> &WorkCell {
        self.0.checker.cell()
    }

    /// Returns the limits of the arms.
    #[must_use]
    pub fn settings(&self) -> &Settings {
        self.0.checker.settings()
    }

    /// Returns a receiver of snapshots. A slow receiver sees only the newest one.
    #[must_use]
    pub fn watch(&self) -> watch::Receiver<Arc<Snapshot>> {
        self.0.watch()
    }

    /// Stops the arms before all waiting calls. Returns the stop that they are in, which may precede this call.
    ///
    /// # Errors
    /// Returns an error if the drives could not be commanded to stop, the arms do not confirm it in time, or the thread
    /// does not respond.
    pub async fn stop(&self) -> Result<Option<Stop>, Error> {
        Ok(self.0.stop().await?.stopped.clone())
    }
}
