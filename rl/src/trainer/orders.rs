//! Orders of episodes: those of a round, and those of an evaluation.

use tandem_core::episode::EpisodeKind;
use tandem_core::work::{EpisodeExploration, EpisodeOrder, SlotOrder};

use super::Trainer;
use crate::config::EVALUATION_SLOT_EPISODES;

impl Trainer {
    /// Returns the training slots of round `round`, for parameter version `version`.
    #[must_use]
    pub fn training_orders(&self, round: u64, version: u64) -> Vec<SlotOrder> {
        let per_round = self.config.episodes_per_round();
        let warmup_env_steps = self.config.rounds.warmup_env_steps;
        let warmup_episodes = warmup_env_steps.div_ceil(self.task.episode_steps() as u64);
        let greedy_share = self.config.at_round(round).greedy_share;
        let n_rounds_ahead = round.saturating_sub(self.counters.round);
        let advised_steps = self.jump_start.map(|jump_start| jump_start.horizon(n_rounds_ahead));
        let asks = self.config.advice.asks() && advised_steps != Some(0);
        let orders: Vec<EpisodeOrder> = (round * per_round..(round + 1) * per_round)
            .map(|number| {
                let advised = asks && is_advised(number, self.config.advice.share);
                let exploration = if number < warmup_episodes {
                    EpisodeExploration::Uniform
                } else if !advised && is_greedy(number, greedy_share) {
                    EpisodeExploration::Greedy
                } else {
                    EpisodeExploration::Noise
                };
                EpisodeOrder {
                    number,
                    seed: self.config.seed,
                    advised,
                    exploration,
                    record: false,
                    advised_steps,
                }
            })
            .collect();
        slots(&orders, self.config.rounds.rollouts, EpisodeKind::Training, version)
    }

    /// Returns the slots of an evaluation of parameter version `version` on the run's fixed goals.
    #[must_use]
    pub fn evaluation_orders(&self, version: u64) -> Vec<SlotOrder> {
        let evaluation = &self.config.evaluation;
        let order = |number| EpisodeOrder {
            number,
            seed: evaluation.seed,
            advised: false,
            exploration: EpisodeExploration::Noise,
            record: number < evaluation.recorded_episodes,
            advised_steps: None,
        };
        let orders: Vec<EpisodeOrder> = (0..evaluation.episodes).map(order).collect();
        slots(&orders, EVALUATION_SLOT_EPISODES, EpisodeKind::Evaluation, version)
    }
}

/// Returns true if episode `number` is advised. Advised episodes are evenly spread.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "episode numbers stay far below 2^52"
)]
pub(super) fn is_advised(number: u64, share: f64) -> bool {
    let advised_before = |number: u64| (number as f64 * share).floor() as u64;
    advised_before(number + 1) > advised_before(number)
}

/// Returns true if an episode is among the fraction `share` that are greedy. Multiples of the golden ratio spread them
/// evenly, whichever episodes are advised.
#[expect(clippy::cast_precision_loss, reason = "episode numbers stay far below 2^52")]
fn is_greedy(number: u64, share: f64) -> bool {
    const GOLDEN_RATIO: f64 = 0.618_033_988_749_895;
    (number as f64 * GOLDEN_RATIO).fract() < share
}

/// Splits orders into slots of `n_episodes`; the learner's queue numbers them.
fn slots(
    orders: &[EpisodeOrder],
    n_episodes: usize,
    kind: EpisodeKind,
    version: u64,
) -> Vec<SlotOrder> {
    let slot = |episodes: &[EpisodeOrder]| SlotOrder {
        slot: 0,
        parameter_version: version,
        kind,
        episodes: episodes.to_vec(),
    };
    orders.chunks(n_episodes).map(slot).collect()
}
