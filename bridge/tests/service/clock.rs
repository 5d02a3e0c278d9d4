//! A clock for services in tests.

use std::sync::{Condvar, Mutex};
use std::time::Duration;

use tandem_bridge::service::Clock;

/// The shortest duration of a tick, so that tests share the processor.
const TICK: Duration = Duration::from_micros(200);

/// A clock that advances when a thread sleeps, up to a limit set by the test.
#[derive(Default)]
pub(crate) struct TestClock(Mutex<Hands>, Condvar);

#[derive(Default)]
struct Hands {
    now_s: f64,
    /// `None` for no limit.
    until_s: Option<f64>,
    late_s: f64,
}

impl TestClock {
    /// Lets time advance without limit.
    pub(crate) fn free(&self) {
        self.0.lock().unwrap().until_s = None;
        self.1.notify_all();
    }

    /// Holds the time.
    pub(crate) fn hold(&self) {
        let mut hands = self.0.lock().unwrap();
        hands.until_s = Some(hands.now_s);
    }

    /// Raises the limit by `seconds`.
    pub(crate) fn pass(&self, seconds: f64) {
        let mut hands = self.0.lock().unwrap();
        let until_s = hands.until_s.unwrap_or(hands.now_s);
        hands.until_s = Some(until_s.max(hands.now_s) + seconds);
        self.1.notify_all();
    }

    /// Lengthens the next sleep by `seconds`.
    pub(crate) fn oversleep(&self, seconds: f64) {
        self.0.lock().unwrap().late_s = seconds;
    }
}

impl Clock for TestClock {
    fn now_s(&self) -> f64 {
        self.0.lock().unwrap().now_s
    }

    fn sleep_until(&self, when_s: f64) {
        std::thread::sleep(TICK);
        let hands = self.0.lock().unwrap();
        let is_held = |hands: &mut Hands| hands.until_s.is_some_and(|until_s| when_s > until_s);
        let mut hands = self.1.wait_while(hands, is_held).unwrap();
        hands.now_s = hands.now_s.max(when_s) + std::mem::take(&mut hands.late_s);
    }
}
