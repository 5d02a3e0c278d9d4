//! Keeps a connection open until the nodes have answered `in/stop`: rosbridge discards calls that it has not processed
//! when a connection closes.

use std::time::Duration;

use super::KinovaRosDriver;
use super::node::{ArmNode, Control, Service};

/// Number of waits for answers, and the longest of each: half a second in all.
const N_WAITS: u32 = 50;
const WAIT: Duration = Duration::from_millis(10);

impl KinovaRosDriver {
    /// Waits until every node that was asked to stop has answered, for at most half a second.
    ///
    /// Malformed and unexpected messages do not end the wait.
    pub(super) fn await_stops(&mut self) {
        let is_pending =
            |arm: &ArmNode| matches!(arm.control, Control::Pending { service: Service::Stop, .. });
        for _ in 0..N_WAITS {
            self.drain().ok();
            if !self.arms.iter().any(is_pending) || self.socket.wait(WAIT).is_err() {
                return;
            }
        }
    }
}

impl Drop for KinovaRosDriver {
    fn drop(&mut self) {
        if self.failure.is_none() {
            self.await_stops();
        }
    }
}
