//! Conversions for `learner.proto`: work that a learner assigns, parameters, and episodes that workers return.

mod episode;
mod parameters;

use tandem_core::task::MAX_ARMS;
use tandem_core::work::{EpisodeExploration, EpisodeOrder, RunTerms, SlotOrder};
use tandem_core::{
    AdviceTerms, AdviceUnit, EpisodeKind, Exploration, JudgedAction, Layout, Task, TaskSpec,
    WorldSettings,
};

use crate::advice::decode_account_name;
use crate::error::DecodeError;
use crate::numbers::{count_within, one_within};
use crate::pb;
use crate::task::{decode_task, encode_task};

pub(crate) use episode::decode_contact;
pub use episode::{decode_episode, encode_episode};
pub use parameters::{decode_actor, encode_actor};

/// Largest number of characters of an unknown name in an error message, which is sent in a header.
const MAX_SHOWN_CHARS: usize = 40;
/// Largest number of episodes per slot.
pub(crate) const MAX_SLOT_EPISODES: usize = 1024;
/// Largest number of physics steps per control step.
pub(crate) const MAX_SUBSTEPS: u32 = 10_000;

const fn encode_episode_kind(kind: EpisodeKind) -> pb::EpisodeKind {
    match kind {
        EpisodeKind::Training => pb::EpisodeKind::Training,
        EpisodeKind::Evaluation => pb::EpisodeKind::Evaluation,
    }
}

fn decode_episode_kind(kind: i32) -> Result<EpisodeKind, DecodeError> {
    match pb::EpisodeKind::try_from(kind) {
        Ok(pb::EpisodeKind::Training) => Ok(EpisodeKind::Training),
        Ok(pb::EpisodeKind::Evaluation) => Ok(EpisodeKind::Evaluation),
        Ok(pb::EpisodeKind::Unspecified) | Err(_) => {
            Err(DecodeError::new("kind", "1 (training) or 2 (evaluation)", kind))
        }
    }
}

/// Encodes the terms of a run.
///
/// # Panics
/// If the number of arms exceeds `u32`.
#[must_use]
pub fn encode_run_terms(terms: &RunTerms) -> pb::RunTerms {
    pb::RunTerms {
        run: terms.run.clone(),
        description: terms.task.as_built_in().is_none().then(|| encode_task(&terms.task)),
        task: terms.task.name().to_owned(),
        n_arms: u32::try_from(terms.task.n_arms()).expect("a task has few arms"),
        account: terms.account.clone().unwrap_or_default(),
        exploration: Some(pb::Exploration {
            noise_std: terms.exploration.noise_std,
            random_share: terms.exploration.random_action_prob,
            random_hold_mean_steps: terms.exploration.sticky_random_mean_steps,
            joint_random_actions: terms.exploration.joint_random_actions,
        }),
        advice: Some(pb::AdviceTerms {
            judges_policy_action: terms.advice.judged_action == JudgedAction::Policy,
            charges_slot_steps: terms.advice.unit == AdviceUnit::SlotStep,
        }),
        world: Some(pb::WorldTerms {
            gripped_start_share: terms.world.grasped_start_prob,
            gripped_start_env_steps: terms.world.grasped_start_env_steps,
            wide_start_share: 0.0,
            substeps: terms.world.substeps,
            randomization: terms.world.randomization,
        }),
        symmetrized_evaluation: terms.symmetrized_evaluation,
    }
}

/// Decodes the terms of a run.
///
/// # Errors
/// Returns an error if the task is unknown, a sub-message is missing or a number is out of range.
pub fn decode_run_terms(terms: pb::RunTerms) -> Result<RunTerms, DecodeError> {
    let exploration = terms.exploration.ok_or_else(|| DecodeError::missing("exploration"))?;
    let world = terms.world.ok_or_else(|| DecodeError::missing("world"))?;
    let account = (!terms.account.is_empty()).then_some(terms.account);
    Ok(RunTerms {
        run: decode_run_name(terms.run)?,
        task: match terms.description {
            None => decode_layout(&terms.task, terms.n_arms)?.into(),
            Some(description) => decode_described(description, &terms.task, terms.n_arms)
                .map_err(|error| error.within("description"))?,
        },
        account: account.map(|name| decode_account_name("account", name)).transpose()?,
        advice: terms.advice.map_or_else(AdviceTerms::default, decode_advice_terms),
        exploration: decode_exploration(exploration)
            .map_err(|error| error.within("exploration"))?,
        world: decode_world(world).map_err(|error| error.within("world"))?,
        symmetrized_evaluation: terms.symmetrized_evaluation,
    })
}

/// The name of a run; empty from a learner that does not send it.
fn decode_run_name(name: String) -> Result<String, DecodeError> {
    if name.is_empty() { Ok(name) } else { decode_account_name("run", name) }
}

fn decode_layout(task: &str, n_arms: u32) -> Result<Layout, DecodeError> {
    let Ok(known_task) = task.parse::<Task>() else {
        let beginning: String = task.chars().take(MAX_SHOWN_CHARS).collect();
        let got = format_args!("{beginning:?}").to_string();
        return Err(DecodeError::new("task", "the name of a built-in task", got));
    };
    let n_known_arms =
        usize::try_from(n_arms).ok().filter(|n_arms| (1..=MAX_ARMS).contains(n_arms));
    let too_many = || DecodeError::new("n_arms", format_args!("1 to {MAX_ARMS}"), n_arms);
    Ok(Layout::new(known_task, n_known_arms.ok_or_else(too_many)?))
}

/// Decodes the task of a run, whose name and number of arms the terms repeat.
fn decode_described(
    description: pb::TaskDescription,
    name: &str,
    n_arms: u32,
) -> Result<TaskSpec, DecodeError> {
    let task = decode_task(description)?;
    if task.name() != name {
        return Err(DecodeError::new(
            "name",
            "the name in `task`",
            format_args!("{:?}", task.name()),
        ));
    }
    if u32::try_from(task.n_arms()).ok() != Some(n_arms) {
        return Err(DecodeError::new("number of arms", format_args!("{n_arms}"), task.n_arms()));
    }
    Ok(task)
}

/// Decodes how workers ask for advice. All values of its fields are valid.
const fn decode_advice_terms(advice: pb::AdviceTerms) -> AdviceTerms {
    AdviceTerms {
        judged_action: match advice.judges_policy_action {
            true => JudgedAction::Policy,
            false => JudgedAction::Executed,
        },
        unit: match advice.charges_slot_steps {
            true => AdviceUnit::SlotStep,
            false => AdviceUnit::EnvStep,
        },
    }
}

fn decode_exploration(exploration: pb::Exploration) -> Result<Exploration, DecodeError> {
    let hold = exploration.random_hold_mean_steps;
    Ok(Exploration {
        noise_std: one_within("noise_std", exploration.noise_std, &(0.0..=f32::INFINITY))?,
        random_action_prob: one_within("random_share", exploration.random_share, &(0.0..=1.0))?,
        sticky_random_mean_steps: one_within(
            "random_hold_mean_steps",
            hold,
            &(1.0..=f32::INFINITY),
        )?,
        joint_random_actions: exploration.joint_random_actions,
    })
}

fn decode_world(world: pb::WorldTerms) -> Result<WorldSettings, DecodeError> {
    if world.wide_start_share != 0.0 {
        let expected = "0, there are no such starts any more";
        return Err(DecodeError::new("wide_start_share", expected, world.wide_start_share));
    }
    Ok(WorldSettings {
        grasped_start_prob: one_within(
            "gripped_start_share",
            world.gripped_start_share,
            &(0.0..=1.0),
        )?,
        grasped_start_env_steps: world.gripped_start_env_steps,
        substeps: count_within("substeps", world.substeps, &(1..=MAX_SUBSTEPS))?,
        randomization: one_within("randomization", world.randomization, &(0.0..=1.0))?,
    })
}

const fn encode_episode_order(order: &EpisodeOrder) -> pb::EpisodeOrder {
    pb::EpisodeOrder {
        number: order.number,
        seed: order.seed,
        advised: order.advised,
        uniform: matches!(order.exploration, EpisodeExploration::Uniform),
        record: order.record,
        advised_steps: order.advised_steps,
        greedy: matches!(order.exploration, EpisodeExploration::Greedy),
    }
}

fn decode_episode_order(order: pb::EpisodeOrder) -> Result<EpisodeOrder, DecodeError> {
    if order.uniform && order.greedy {
        return Err(DecodeError::new("greedy", "false if uniform is true", true));
    }
    Ok(EpisodeOrder {
        number: order.number,
        seed: order.seed,
        advised: order.advised,
        exploration: match (order.uniform, order.greedy) {
            (true, _) => EpisodeExploration::Uniform,
            (_, true) => EpisodeExploration::Greedy,
            _ => EpisodeExploration::Noise,
        },
        record: order.record,
        advised_steps: order.advised_steps,
    })
}

/// Encodes a slot.
#[must_use]
pub fn encode_slot(slot: &SlotOrder) -> pb::Slot {
    pb::Slot {
        slot: slot.slot,
        parameter_version: slot.parameter_version,
        kind: encode_episode_kind(slot.kind).into(),
        episodes: slot.episodes.iter().map(encode_episode_order).collect(),
    }
}

/// Decodes a slot.
///
/// # Errors
/// Returns an error if the kind is unknown, the slot does not have 1 to 1024 episodes, or one of them is both uniform
/// and greedy.
pub fn decode_slot(slot: pb::Slot) -> Result<SlotOrder, DecodeError> {
    if !(1..=MAX_SLOT_EPISODES).contains(&slot.episodes.len()) {
        let expected = format_args!("1 to {MAX_SLOT_EPISODES} episodes").to_string();
        return Err(DecodeError::new("episodes", expected, slot.episodes.len()));
    }
    Ok(SlotOrder {
        slot: slot.slot,
        parameter_version: slot.parameter_version,
        kind: decode_episode_kind(slot.kind)?,
        episodes: slot
            .episodes
            .into_iter()
            .enumerate()
            .map(|(idx, order)| {
                decode_episode_order(order)
                    .map_err(|error| error.within(format_args!("episodes[{idx}]")))
            })
            .collect::<Result<_, _>>()?,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    const LAYOUT: Layout = Layout::new(Task::Push, 2);

    fn terms() -> RunTerms {
        RunTerms {
            run: "run-7".to_owned(),
            task: LAYOUT.into(),
            account: Some("run-7".to_owned()),
            advice: AdviceTerms { judged_action: JudgedAction::Policy, unit: AdviceUnit::SlotStep },
            exploration: Exploration {
                noise_std: 0.2,
                random_action_prob: 0.3,
                sticky_random_mean_steps: 4.0,
                joint_random_actions: true,
            },
            symmetrized_evaluation: true,
            world: WorldSettings {
                grasped_start_prob: 1.0,
                grasped_start_env_steps: 30_000,
                substeps: 20,
                randomization: 0.5,
            },
        }
    }

    fn slot() -> SlotOrder {
        let order = |number, advised, exploration| EpisodeOrder {
            number,
            seed: 42,
            advised,
            exploration,
            record: advised,
            advised_steps: advised.then_some(17),
        };
        SlotOrder {
            slot: 3,
            parameter_version: 9,
            kind: EpisodeKind::Evaluation,
            episodes: vec![
                order(64, true, EpisodeExploration::Noise),
                order(65, false, EpisodeExploration::Uniform),
                order(66, false, EpisodeExploration::Greedy),
            ],
        }
    }

    fn sent<M: prost::Message + Default>(message: &M) -> M {
        M::decode(message.encode_to_vec().as_slice()).unwrap()
    }

    #[test]
    fn every_message_round_trips() {
        assert_eq!(decode_run_terms(sent(&encode_run_terms(&terms()))), Ok(terms()));
        let unadvised = RunTerms { account: None, run: String::new(), ..terms() };
        assert_eq!(decode_run_terms(sent(&encode_run_terms(&unadvised))), Ok(unadvised));
        assert_eq!(decode_slot(sent(&encode_slot(&slot()))), Ok(slot()));
    }

    #[test]
    fn terms_without_the_advice_of_later_versions_have_its_defaults() {
        let mut former = encode_run_terms(&terms());
        former.advice = None;
        let decoded = decode_run_terms(former).unwrap();
        assert_eq!(decoded, RunTerms { advice: AdviceTerms::default(), ..terms() });
    }

    #[test]
    fn malformed_terms_are_refused_by_name() {
        let check = |corrupt: fn(&mut pb::RunTerms), message: &str| {
            let mut malformed = encode_run_terms(&terms());
            corrupt(&mut malformed);
            assert_eq!(decode_run_terms(malformed).unwrap_err().to_string(), message);
        };
        check(
            |t| t.task = "pick".to_owned(),
            "task: expected the name of a built-in task, got \"pick\"",
        );
        check(|t| t.n_arms = 0, "n_arms: expected 1 to 8, got 0");
        check(|t| t.n_arms = 9, "n_arms: expected 1 to 8, got 9");
        check(|t| t.exploration = None, "exploration: expected a message, got none");
        check(|t| t.world = None, "world: expected a message, got none");
        check(
            |t| t.world.as_mut().unwrap().substeps = 0,
            "world.substeps: expected 1 to 10000, got 0",
        );
        check(
            |t| t.world.as_mut().unwrap().gripped_start_share = f32::NAN,
            "world.gripped_start_share: expected a number in [0, 1], got NaN",
        );
        check(
            |t| t.world.as_mut().unwrap().wide_start_share = 0.5,
            "world.wide_start_share: expected 0, there are no such starts any more, got 0.5",
        );
        let mut malformed = encode_run_terms(&terms());
        malformed.exploration = Some(pb::Exploration {
            random_hold_mean_steps: 0.5,
            ..malformed.exploration.take().unwrap()
        });
        let message =
            "exploration.random_hold_mean_steps: expected a finite number, 1 or more, got 0.5";
        assert_eq!(decode_run_terms(malformed).unwrap_err().to_string(), message);
    }

    #[test]
    fn a_malformed_slot_is_refused_by_name() {
        let check = |corrupt: fn(&mut pb::Slot), message: &str| {
            let mut malformed = encode_slot(&slot());
            corrupt(&mut malformed);
            assert_eq!(decode_slot(malformed).unwrap_err().to_string(), message);
        };
        check(|s| s.kind = 0, "kind: expected 1 (training) or 2 (evaluation), got 0");
        check(|s| s.kind = 3, "kind: expected 1 (training) or 2 (evaluation), got 3");
        check(|s| s.episodes.clear(), "episodes: expected 1 to 1024 episodes, got 0");
        check(
            |s| s.episodes[1].greedy = true,
            "episodes[1].greedy: expected false if uniform is true, got true",
        );
    }
}
