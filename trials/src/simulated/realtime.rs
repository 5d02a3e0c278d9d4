//! The simulated pair in real time.

use std::sync::Arc;

use crate::simulated::{PERIOD_S, SimulatedPair};
use tandem_bridge::driver::{Command, Driver, DriverError, PairState};
use tandem_bridge::service::Time;

/// Most periods that are caught up with before an exchange. After so many without a command the drives have braked.
const MOST_MISSED: u32 = 10;

/// A simulated pair that does not wait for commands: when one comes late, the arms have gone on meanwhile as real ones
/// do, and brake by themselves when none has come for too long.
///
/// States are those of exchanges: what passed between them is not told.
pub struct Paced {
    pair: SimulatedPair,
    time: Arc<dyn Time>,
    /// When the pair's own time was 0, by the clock, seconds; `None` before the first exchange.
    began_s: Option<f64>,
    n_exchanges: u64,
}

impl Paced {
    /// `pair` by the clock of `time`.
    #[must_use]
    pub fn new(pair: SimulatedPair, time: Arc<dyn Time>) -> Self {
        Self { pair, time, began_s: None, n_exchanges: 0 }
    }

    /// Lets the periods pass in which no command came.
    fn catch_up(&mut self) {
        let (now_s, coming_s) = (self.time.now_s(), self.pair.time_s() + PERIOD_S);
        let began_s = self.began_s.get_or_insert(now_s - coming_s);
        let missed = ((now_s - *began_s - coming_s) / PERIOD_S).round();
        let caught_up = missed.clamp(0.0, f64::from(MOST_MISSED));
        *began_s += (missed - caught_up).max(0.0) * PERIOD_S;
        let mut passed = 0.0;
        while passed < caught_up {
            self.pair.pass();
            passed += 1.0;
        }
    }
}

impl Driver for Paced {
    fn period_s(&self) -> f64 {
        PERIOD_S
    }

    fn exchange(&mut self, command: &Command) -> Result<PairState, DriverError> {
        self.catch_up();
        let state = self.pair.exchange(command)?;
        self.n_exchanges += 1;
        Ok(PairState { sequence: self.n_exchanges, ..state })
    }

    fn stop(&mut self) -> Result<(), DriverError> {
        self.pair.stop()
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Mutex;

    use super::*;
    use crate::SimulatedConfig;
    use tandem_bridge::Order;
    use tandem_bridge::layout::mico_cell;

    struct Set(Mutex<f64>);

    impl Time for Set {
        fn now_s(&self) -> f64 {
            *self.0.lock().unwrap()
        }

        fn sleep_until(&self, _: f64) {}
    }

    #[test]
    fn the_arms_live_on_while_no_command_comes() {
        let cell = mico_cell();
        let at = cell.ready(0.05).unwrap();
        let pair = SimulatedPair::new(cell, &at, 0.5, SimulatedConfig::default());
        let time = Arc::new(Set(Mutex::new(100.0)));
        let mut paced = Paced::new(pair, time.clone());
        let mut number = 0;
        let mut exchange = |now_s: f64| {
            *time.0.lock().unwrap() = now_s;
            number += 1;
            paced.exchange(&Command { number, order: Order::Stop }).unwrap()
        };
        let check = |state: PairState, sequence, stamp_s: f64| {
            assert_eq!(state.sequence, sequence);
            assert!((state.stamp_s - stamp_s).abs() < 1e-9, "{}", state.stamp_s);
        };
        check(exchange(100.0), 1, 0.01);
        check(exchange(100.0104), 2, 0.02);
        check(exchange(100.0496), 3, 0.06);
        // Nobody waits for a minute of simulation.
        check(exchange(160.0), 4, 0.17);
        check(exchange(160.01), 5, 0.18);
    }
}
