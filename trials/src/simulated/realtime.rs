//! The simulated pair in real time.

use std::sync::Arc;

use crate::simulated::{Drill, PERIOD_S, SimulatedPair};
use tandem_bridge::driver::{Command, Driver, DriverError, PairState};
use tandem_bridge::service::Clock;

/// The largest number of missed periods that an exchange simulates. After that many the drives have braked.
const MAX_MISSED: u32 = 10;

/// A simulated pair that does not wait for commands. Before a late command the arms continue to move like real ones,
/// and they brake by themselves if no command arrives for too long.
///
/// Only exchanges return states; the periods between them are not reported.
pub struct RealTimePair {
    pair: SimulatedPair,
    clock: Arc<dyn Clock>,
    /// The clock's time at the pair's time 0, seconds; `None` before the first exchange.
    began_s: Option<f64>,
    n_exchanges: u64,
    drill: Option<Drill>,
}

impl RealTimePair {
    /// Runs `pair` in the time of `clock`.
    #[must_use]
    pub fn new(pair: SimulatedPair, clock: Arc<dyn Clock>) -> Self {
        Self { pair, clock, began_s: None, n_exchanges: 0, drill: None }
    }

    /// Applies the faults of a drill to the pair.
    #[must_use]
    pub fn with_drill(self, drill: Drill) -> Self {
        Self { drill: Some(drill), ..self }
    }

    /// Simulates the periods in which no command arrived.
    fn catch_up(&mut self) {
        let (now_s, coming_s) = (self.clock.now_s(), self.pair.time_s() + PERIOD_S);
        let began_s = self.began_s.get_or_insert(now_s - coming_s);
        let missed = ((now_s - *began_s - coming_s) / PERIOD_S).round();
        let caught_up = missed.clamp(0.0, f64::from(MAX_MISSED));
        *began_s += (missed - caught_up).max(0.0) * PERIOD_S;
        let mut passed = 0.0;
        while passed < caught_up {
            self.pair.skip_period();
            passed += 1.0;
        }
    }
}

impl Driver for RealTimePair {
    fn period_s(&self) -> f64 {
        PERIOD_S
    }

    fn exchange(&mut self, command: &Command) -> Result<PairState, DriverError> {
        if let Some(drill) = &mut self.drill {
            drill.apply(&mut self.pair);
        }
        self.catch_up();
        let state = self.pair.exchange(command)?;
        self.n_exchanges += 1;
        let state = PairState { sequence: self.n_exchanges, ..state };
        Ok(match &mut self.drill {
            Some(drill) => drill.delayed(state),
            None => state,
        })
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
    use tandem_bridge::work_cell::mico_cell;

    struct ManualClock(Mutex<f64>);

    impl Clock for ManualClock {
        fn now_s(&self) -> f64 {
            *self.0.lock().unwrap()
        }

        fn sleep_until(&self, _: f64) {}
    }

    #[test]
    fn the_arms_continue_to_move_between_commands() {
        let cell = mico_cell();
        let at = cell.ready(0.05).unwrap();
        let pair = SimulatedPair::new(cell, &at, 0.5, SimulatedConfig::default());
        let clock = Arc::new(ManualClock(Mutex::new(100.0)));
        let mut realtime = RealTimePair::new(pair, clock.clone());
        let mut number = 0;
        let mut exchange = |now_s: f64| {
            *clock.0.lock().unwrap() = now_s;
            number += 1;
            realtime.exchange(&Command { number, order: Order::Stop }).unwrap()
        };
        let check = |state: PairState, sequence, stamp_s: f64| {
            assert_eq!(state.sequence, sequence);
            assert!((state.stamp_s - stamp_s).abs() < 1e-9, "{}", state.stamp_s);
        };
        check(exchange(100.0), 1, 0.01);
        check(exchange(100.0104), 2, 0.02);
        check(exchange(100.0496), 3, 0.06);
        // An exchange does not simulate a whole minute.
        check(exchange(160.0), 4, 0.17);
        check(exchange(160.01), 5, 0.18);
    }
}
