//! Checks of delivered episodes: they must match the order, and their claims of advice must be possible.

use std::collections::BTreeMap;

use tandem_core::work::{EpisodeOrder, SlotOrder};
use tandem_core::{AdviceUnit, Episode, EpisodeKind};

/// A refusal of a worker's call or episodes. None of the episodes is used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum QueueError {
    /// The worker must join first.
    #[error("worker {0} is unknown here: join first")]
    UnknownWorker(u64),
    /// The slot was never ordered.
    #[error("slot: expected one of the {n_slots} that were ordered, got {slot}")]
    UnknownSlot {
        /// The slot that was named.
        slot: u64,
        /// Slots ordered so far.
        n_slots: u64,
    },
    /// More or fewer episodes than the slot has.
    #[error("episodes: expected the {expected} of slot {slot}, got {got}")]
    WrongCount {
        /// The slot.
        slot: u64,
        /// Episodes ordered.
        expected: usize,
        /// Episodes received.
        got: usize,
    },
    /// An episode does not match its order.
    #[error("episode {number}: {field}: expected {expected}, got {got}")]
    WrongEpisode {
        /// The episode's number as received.
        number: u64,
        /// The field that does not match.
        field: &'static str,
        /// The ordered value.
        expected: String,
        /// The received value.
        got: String,
    },
}

/// Checks the number of episodes of a slot.
///
/// # Errors
/// When it differs from the order.
pub fn check_count(order: &SlotOrder, got: usize) -> Result<(), QueueError> {
    let expected = order.episodes.len();
    if got == expected {
        return Ok(());
    }
    Err(QueueError::WrongCount { slot: order.slot, expected, got })
}

pub(super) fn check(
    order: &SlotOrder,
    unit: AdviceUnit,
    episodes: &[Episode],
) -> Result<(), QueueError> {
    check_count(order, episodes.len())?;
    let ordered = || episodes.iter().zip(&order.episodes);
    ordered().try_for_each(|(episode, ordered)| check_episode(order, ordered, episode))?;
    if order.kind != EpisodeKind::Training {
        return Ok(());
    }
    let advised = ordered().filter(|(_, ordered)| ordered.advised).map(|(episode, _)| episode);
    let advised: Vec<&Episode> = advised.collect();
    let n_claimable = |idx: usize| match (unit, idx) {
        (AdviceUnit::EnvStep, _) => n_advised_steps(&advised[idx..=idx]),
        (AdviceUnit::SlotStep, 0) => n_advised_steps(&advised),
        (AdviceUnit::SlotStep, _) => 0,
    };
    advised.iter().enumerate().try_for_each(|(idx, episode)| check_claim(episode, n_claimable(idx)))
}

/// Returns the number of steps with an advised arm in any of `episodes`.
fn n_advised_steps(episodes: &[&Episode]) -> usize {
    let n_steps = episodes.iter().map(|episode| episode.advised_arms.len()).max().unwrap_or(0);
    let is_advised = |step: &usize| {
        let arms = episodes.iter().filter_map(|episode| episode.advised_arms.get(*step));
        arms.copied().any(|arms| arms != 0)
    };
    (0..n_steps).filter(is_advised).count()
}

/// Checks that an advised episode claims `n_advised` units: a unit pays for one step, regardless of the number of
/// overridden arms, and a step without an overridden arm costs nothing.
fn check_claim(episode: &Episode, n_advised: usize) -> Result<(), QueueError> {
    let claimed = episode.advice_charged;
    if usize::try_from(claimed) == Ok(n_advised) {
        return Ok(());
    }
    Err(QueueError::WrongEpisode {
        number: episode.number,
        field: "advice_charged",
        expected: format!("{n_advised}, the steps with an advised arm"),
        got: claimed.to_string(),
    })
}

fn check_episode(
    order: &SlotOrder,
    ordered: &EpisodeOrder,
    episode: &Episode,
) -> Result<(), QueueError> {
    let refuse = |field, expected: String, got: String| {
        Err(QueueError::WrongEpisode { number: episode.number, field, expected, got })
    };
    let (number, version) = (episode.number, episode.parameter_version);
    if number != ordered.number {
        return refuse("number", ordered.number.to_string(), number.to_string());
    }
    if episode.kind != order.kind {
        return refuse("kind", format!("{:?}", order.kind), format!("{:?}", episode.kind));
    }
    if version != order.parameter_version {
        let expected = order.parameter_version.to_string();
        return refuse("parameter_version", expected, version.to_string());
    }
    check_advice(order, ordered, episode)
}

/// Checks that an episode claims no advice unless it was ordered.
fn check_advice(
    order: &SlotOrder,
    ordered: &EpisodeOrder,
    episode: &Episode,
) -> Result<(), QueueError> {
    let refuse = |field, expected, got| {
        Err(QueueError::WrongEpisode { number: episode.number, field, expected, got })
    };
    if ordered.advised && order.kind == EpisodeKind::Training {
        let mut steps = episode.advised_arms.iter().enumerate();
        return match steps.find(|(step_idx, arms)| **arms != 0 && !ordered.asks_on(*step_idx)) {
            None => Ok(()),
            Some((step_idx, arms)) => {
                let n_steps = ordered.advised_steps.unwrap_or_default();
                let expected = format!("no advised arm after the first {n_steps} steps");
                refuse("advised_arms", expected, format!("{arms:#010b} on step {step_idx}"))
            }
        };
    }
    let claimed = episode.advice_charged;
    if claimed > 0 {
        let expected = "0, as no advice was ordered".to_owned();
        return refuse("advice_charged", expected, claimed.to_string());
    }
    match episode.advised_arms.iter().position(|arms| *arms != 0) {
        None => Ok(()),
        Some(step_idx) => {
            let expected = "no advised arm, as no advice was ordered".to_owned();
            let got = format!("{:#010b} on step {step_idx}", episode.advised_arms[step_idx]);
            refuse("advised_arms", expected, got)
        }
    }
}

/// Checks that no episode claims more units of advice than `limits` has for it.
pub(super) fn check_claims(
    limits: &BTreeMap<u64, u32>,
    order: &SlotOrder,
    episodes: &[Episode],
) -> Result<(), QueueError> {
    // Evaluation episodes are numbered separately and claim nothing.
    if order.kind != EpisodeKind::Training {
        return Ok(());
    }
    for episode in episodes {
        let (number, claimed) = (episode.number, episode.advice_charged);
        if let Some(units) = limits.get(&number).filter(|units| claimed > **units) {
            return Err(QueueError::WrongEpisode {
                number,
                field: "advice_charged",
                expected: format!("at most {units}, the units reserved for it"),
                got: claimed.to_string(),
            });
        }
    }
    Ok(())
}
