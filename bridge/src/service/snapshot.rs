//! The state of the arms after each tick, and queues in which observers receive all of them.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use tandem_core::scene::Scene;
use tandem_kinematics::{ForwardKinematics, Gaps, Joints, WorkCell};
use tokio::sync::mpsc;

use crate::driver::{DriverError, PairState};
use crate::executor::{Phase, Progress, Stop};
use crate::service::reason_codes::of_cause;

/// The state that the arms' thread publishes after each tick.
#[derive(Debug, Clone)]
pub struct Snapshot {
    /// The time of the tick by the service's clock, seconds.
    pub now_s: f64,
    /// The phase of the arms.
    pub phase: Phase,
    /// The stop that the arms are in, while they are stopped.
    pub stopped: Option<Stop>,
    /// True if the last exchange with the arms failed.
    pub exchange_failed: bool,
    /// The error of the last attempt to stop the drives, until a command gets through.
    pub stop_error: Option<DriverError>,
    /// True if the arms have confirmed the last requested stop.
    pub(super) stop_is_confirmed: bool,
    /// The time until the owner's lease ends unless it is renewed, seconds; `None` if the arms have no owner.
    pub lease_left_s: Option<f64>,
    /// True if all joints were at rest in the newest state.
    pub at_rest: bool,
    /// The newest valid state of the arms.
    pub state: Option<PairState>,
    /// The commanded openings of the grippers, arm by arm; `None` while the arms are stopped.
    pub openings: Option<Vec<f64>>,
    /// The joint angles that the motion prescribes, radians, arm by arm.
    pub reference: Option<Vec<Joints>>,
    /// The motion in progress.
    pub motion: Option<Arc<MotionInfo>>,
    /// The progress of the motion.
    pub progress: Option<Progress>,
    /// The number of motions that have been started.
    pub n_motions: u64,
    /// The number of stops and faults so far.
    pub(super) n_halts: u64,
    /// The number of stops that have been carried out.
    pub(super) n_stops: u64,
}

/// A motion that a client executes.
#[derive(Debug, Clone, PartialEq)]
pub struct MotionInfo {
    /// The name that the client gave it; may be empty.
    pub name: String,
    /// The address of the client; empty if it is not known.
    pub client: String,
    /// The share of the motion's own speed at which it is played, in (0, 1].
    pub speed: f64,
    /// The duration at its own speed, seconds.
    pub duration_s: f64,
}

impl Snapshot {
    /// Returns the name of the cause of the present stop, such as `requested`.
    #[must_use]
    pub fn stop_name(&self) -> Option<&'static str> {
        self.stopped.as_ref().map(|stop| of_cause(&stop.cause).0)
    }

    /// Returns the shapes of the arms as measured, in `cell`; `None` without a valid state.
    #[must_use]
    pub fn scene(&self, cell: &WorkCell) -> Option<Scene> {
        let (angles, openings) = self.measured()?;
        Some(cell.scene(&angles, &openings, self.now_s))
    }

    /// Returns the gaps of the arms as measured, in `cell`; `None` without a valid state.
    #[must_use]
    pub fn gaps(&self, cell: &WorkCell) -> Option<Gaps> {
        let (angles, openings) = self.measured()?;
        Some(cell.gaps_with(&angles, &openings))
    }

    /// Returns the positions of the tools as measured, world frame, metres, arm by arm; empty without a valid state.
    #[must_use]
    pub fn tools(&self, cell: &WorkCell) -> Vec<[f64; 3]> {
        self.measured().map(|(angles, _)| tools(cell, &angles)).unwrap_or_default()
    }

    /// Returns the positions of the tools that the motion prescribes, world frame, metres, arm by arm; empty without a
    /// motion.
    #[must_use]
    pub fn planned_tools(&self, cell: &WorkCell) -> Vec<[f64; 3]> {
        self.reference.as_ref().map(|reference| tools(cell, reference)).unwrap_or_default()
    }

    /// Returns the joint angles (radians) and gripper openings, arm by arm.
    fn measured(&self) -> Option<(Vec<Joints>, Vec<f64>)> {
        let state = self.state.as_ref()?;
        Some(state.arms.iter().map(|arm| (arm.angles, arm.opening)).unzip())
    }
}

fn tools(cell: &WorkCell, angles: &[Joints]) -> Vec<[f64; 3]> {
    let arms = cell.arms.iter().zip(angles);
    arms.map(|(placed, angles)| {
        let tool_in_base_m = ForwardKinematics::new(placed.model, angles).tool_m();
        (placed.world_from_base() * tool_in_base_m).into()
    })
    .collect()
}

/// Creates a queue of at most `capacity` snapshots. The arms' thread never waits for it: what does not fit is lost and
/// counted.
///
/// # Panics
/// If `capacity` is 0.
#[must_use]
pub fn observe(capacity: usize) -> (Observer, Snapshots) {
    let (queue, waiting) = mpsc::channel(capacity);
    let n_lost = Arc::new(AtomicU64::new(0));
    (Observer { queue, n_lost: Arc::clone(&n_lost) }, Snapshots { waiting, n_lost })
}

/// The sender of a queue of snapshots.
#[derive(Debug)]
pub struct Observer {
    queue: mpsc::Sender<Arc<Snapshot>>,
    n_lost: Arc<AtomicU64>,
}

/// The receiver of a queue of snapshots.
#[derive(Debug)]
pub struct Snapshots {
    waiting: mpsc::Receiver<Arc<Snapshot>>,
    n_lost: Arc<AtomicU64>,
}

impl Observer {
    pub(super) fn publish(&self, snapshot: &Arc<Snapshot>) {
        if self.queue.try_send(Arc::clone(snapshot)).is_err() {
            self.n_lost.fetch_add(1, Ordering::Relaxed);
        }
    }
}

impl Snapshots {
    /// Waits for the next snapshot. Returns `None` after the last one.
    ///
    /// # Panics
    /// If it is called on a thread of an asynchronous runtime.
    pub fn wait(&mut self) -> Option<Arc<Snapshot>> {
        self.waiting.blocking_recv()
    }

    /// Returns the number of snapshots that did not fit into the queue.
    #[must_use]
    pub fn n_lost(&self) -> u64 {
        self.n_lost.load(Ordering::Relaxed)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_full_queue_delays_no_sender_and_counts_what_is_lost() {
        let (observer, mut snapshots) = observe(2);
        for number in 1..=5 {
            observer.publish(&Arc::new(Snapshot {
                now_s: f64::from(number),
                phase: Phase::Idle,
                stopped: None,
                exchange_failed: false,
                stop_error: None,
                stop_is_confirmed: true,
                lease_left_s: None,
                at_rest: true,
                state: None,
                openings: None,
                reference: None,
                motion: None,
                progress: None,
                n_motions: 0,
                n_halts: 0,
                n_stops: 0,
            }));
        }
        drop(observer);
        let received: Vec<f64> =
            std::iter::from_fn(|| snapshots.wait()).map(|snapshot| snapshot.now_s).collect();
        assert_eq!((received, snapshots.n_lost()), (vec![1.0, 2.0], 3));
    }
}
