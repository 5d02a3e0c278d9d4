//! The end of a program that has moved arms without a service: stops them and awaits their confirmation.

use std::fmt::Display;

use crate::driver::Driver;
use crate::executor::Executor;
use crate::service::{Clock, next_time};

/// Time in which the arms have to confirm the order to stop, seconds.
const CONFIRM_S: f64 = 1.0;

/// Stops the arms, and ticks until they confirm it, for at most [`CONFIRM_S`]. Returns true if they have.
pub(crate) fn stop<D: Driver>(executor: &mut Executor<D>, clock: &dyn Clock) -> bool {
    let mut at_s = clock.now_s();
    let until_s = at_s + CONFIRM_S;
    executor.stop(at_s);
    while at_s < until_s {
        at_s = next_time(at_s, executor.period_s(), clock.now_s());
        clock.sleep_until(at_s);
        executor.tick(clock.now_s());
        if executor.stop_is_confirmed() && executor.stop_error().is_none() {
            return true;
        }
    }
    false
}

/// Returns the message about arms that have not confirmed the order to stop, after the error that came first.
pub(crate) fn unconfirmed(first: Option<&impl Display>) -> String {
    let first = first.map_or_else(String::new, |error| format!("{error}; "));
    format!(
        "{first}the arms have not confirmed the order to stop within {CONFIRM_S} s: use the emergency stop"
    )
}
