//! The same tests for all ledgers: operations, durability and refusals.

mod crash;
mod files;
mod fixture;
mod full;
mod model;
mod owner;
mod redis_server;
mod semantics;
mod servers;
mod speed;
mod upgrade;

/// Every test of `semantics` and `model` on every ledger.
macro_rules! on_every_ledger {
    ($($module:ident::$test:ident),* $(,)?) => {
        mod memory {
            $(#[test] fn $test() { crate::ledger_tests::$module::$test(crate::ledger_tests::fixture::TestLedger::memory()); })*
        }
        mod sqlite {
            $(#[test] fn $test() { crate::ledger_tests::$module::$test(crate::ledger_tests::fixture::TestLedger::sqlite()); })*
        }
        mod redis {
            $(#[test] fn $test() {
                if let Some(fixture) = crate::ledger_tests::fixture::TestLedger::redis() {
                    crate::ledger_tests::$module::$test(fixture);
                }
            })*
        }
    };
}

on_every_ledger! {
    semantics::an_account_is_opened_once_and_keeps_its_terms,
    semantics::an_account_that_is_not_open_is_refused_by_name,
    semantics::a_request_is_charged_as_a_whole_or_not,
    semantics::a_request_that_another_strategy_decided_charges_nothing,
    semantics::an_episode_without_a_lease_has_no_end,
    semantics::a_repeated_operation_changes_nothing,
    semantics::leases_take_what_is_left_in_the_order_of_the_episodes,
    semantics::a_settled_lease_flows_back_once_and_pays_no_more,
    semantics::the_first_half_is_handed_out_first,
    semantics::a_lease_says_how_many_of_its_units_are_early,
    semantics::a_step_without_a_unit_stays_uncharged,
    semantics::charges_before_a_lease_do_not_count_against_it,
    semantics::the_largest_numbers_are_kept_to_the_last_digit,
    semantics::any_name_of_up_to_256_bytes_is_an_account_of_its_own,
    semantics::requests_of_one_call_are_charged_in_their_order,
    semantics::an_empty_request_or_call_changes_nothing,
    model::it_agrees_with_a_ledger_in_memory,
}
