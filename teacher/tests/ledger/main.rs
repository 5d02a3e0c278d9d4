//! All ledgers under the same tests: what they answer, what survives, what they refuse.
//!
//! The modules are `cfg(test)` so that the lints take their helpers for tests too.

#[cfg(test)]
mod crash;
#[cfg(test)]
mod files;
#[cfg(test)]
mod full;
#[cfg(test)]
mod model;
#[cfg(test)]
mod owner;
#[cfg(test)]
mod place;
#[cfg(test)]
mod redis_server;
#[cfg(test)]
mod semantics;
#[cfg(test)]
mod servers;
#[cfg(test)]
mod speed;
#[cfg(test)]
mod upgrade;

/// Every test of `semantics` and `model` on every ledger.
macro_rules! on_every_ledger {
    ($($module:ident::$test:ident),* $(,)?) => {
        mod memory {
            $(#[test] fn $test() { crate::$module::$test(crate::place::Place::memory()); })*
        }
        mod sqlite {
            $(#[test] fn $test() { crate::$module::$test(crate::place::Place::sqlite()); })*
        }
        mod redis {
            $(#[test] fn $test() {
                if let Some(place) = crate::place::Place::redis() {
                    crate::$module::$test(place);
                }
            })*
        }
    };
}

on_every_ledger! {
    semantics::an_account_is_opened_once_and_keeps_its_terms,
    semantics::an_account_that_nobody_opened_is_refused_by_name,
    semantics::a_bill_is_made_as_a_whole_or_not,
    semantics::an_episode_without_a_lease_has_no_end,
    semantics::asking_again_changes_nothing,
    semantics::leases_take_what_is_left_in_the_order_of_the_episodes,
    semantics::a_settled_lease_flows_back_once_and_pays_no_more,
    semantics::the_first_half_is_handed_out_first,
    semantics::a_lease_says_how_many_of_its_units_are_early,
    semantics::a_step_refused_for_want_of_units_stays_refused,
    semantics::what_was_charged_before_the_lease_is_not_the_leases,
    semantics::the_largest_numbers_are_kept_to_the_last_digit,
    semantics::any_name_of_up_to_256_bytes_is_an_account_of_its_own,
    semantics::bills_of_one_call_are_made_in_their_order,
    semantics::an_empty_bill_or_call_is_nothing,
    model::it_does_what_an_account_in_memory_does,
}
