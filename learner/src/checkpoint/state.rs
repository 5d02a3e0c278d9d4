//! Conversion of the learning state to named vectors and numbers, and back.

use std::borrow::Cow;

use safetensors::Dtype;
use tandem_core::work::{PublishedActor, PublishedGate};
use tandem_policy::{Normalizer, NormalizerSnapshot, NormalizerState, Policy};
use tandem_rl::jump_start::JumpStart;
use tandem_rl::replay::{ReplayBuffer, ReplayParts};
use tandem_rl::trainer::{Counters, RoundStats, Trainer};
use tandem_telemetry::MetricsRow;

use super::sealed::{Contents, SETTINGS, Tensor};
use super::{RenamedAccount, Resumption};
use crate::evaluation_store::{EvaluationHistory, PendingEvaluation};
use crate::settings;

/// Largest count of a run: none overflows when it is multiplied by the size of a round.
const MAX_COUNT: u64 = 1 << 48;
/// Largest number of rounds.
const MAX_ROUNDS: u64 = 1 << 32;
/// Largest number of pending evaluations.
const MAX_PENDING: usize = 64;

/// Key of the number of steps on which the teacher was asked. Checkpoints of earlier versions do not have it.
const ADVICE_QUERIES: &str = "advice_queries";
/// Keys of the state of strategy `jsrl:H`, in the order of [`JumpStart::state`].
const JUMP_START: [&str; 4] =
    ["jump_start.present", "jump_start.next", "jump_start.n_episodes", "jump_start.n_succeeded"];

/// Key of the digest of the teacher's policy.
const TEACHER_POLICY: &str = "teacher_policy";
/// Key that is there if the teacher has advised by another policy, too.
const OTHER_POLICY: &str = "teacher_policy.other";
/// Keys of the run's account at the teacher, if it does not have the run's name.
const ACCOUNT_NAME: &str = "advice_account.name";
const ACCOUNT_BUDGET: &str = "advice_account.budget";
/// The critics of the gate of the acting parameters, with strategy `ts2c:T`.
const ACTING_GATE: &str = "acting.gate";

type OwnedTensor = (String, Dtype, Vec<u8>);

/// Returns the numbers and names of a state, in a fixed order.
pub(super) fn metadata(trainer: &Trainer, resumption: &Resumption) -> Vec<(&'static str, String)> {
    let Counters { round, env_steps, episodes, updates, advice_spent, advice_queries } =
        trainer.counters();
    let (_, next) = trainer.replay.parts();
    let config = trainer.config();
    let mut entries = vec![
        ("digest", trainer.digest()),
        ("task", config.task.clone()),
        ("arms", config.arms.to_string()),
        ("seed", config.seed.to_string()),
        ("round", round.to_string()),
        ("env_steps", env_steps.to_string()),
        ("episodes", episodes.to_string()),
        ("updates", updates.to_string()),
        ("advice_spent", advice_spent.to_string()),
        (ADVICE_QUERIES, advice_queries.to_string()),
        ("ddpg.n_updates", trainer.ddpg.n_updates().to_string()),
        ("normalizer.observation.count", trainer.observation_normalizer.state().count.to_string()),
        ("normalizer.goal.count", trainer.goal_normalizer.state().count.to_string()),
        ("replay.next", next.to_string()),
        ("acting.version", resumption.acting.version.to_string()),
        ("pending", resumption.pending.len().to_string()),
        ("wall_s", resumption.wall_s.to_string()),
        (SETTINGS, settings::to_json(config)),
    ];
    let jump_start = trainer.jump_start.iter().flat_map(|jump_start| {
        JUMP_START.into_iter().zip(jump_start.state().map(|number| number.to_string()))
    });
    entries.extend(jump_start);
    entries.extend(resumption.teacher_policy.iter().map(|digest| (TEACHER_POLICY, digest.clone())));
    if resumption.had_other_policy {
        entries.push((OTHER_POLICY, true.to_string()));
    }
    if let Some(RenamedAccount { name, budget }) = &resumption.account {
        entries.extend([(ACCOUNT_NAME, name.clone()), (ACCOUNT_BUDGET, budget.to_string())]);
    }
    entries
}

/// Returns the vectors of a state that are created for the file.
pub(super) fn small_tensors(trainer: &Trainer, resumption: &Resumption) -> Vec<OwnedTensor> {
    let (observation, goal) =
        (trainer.observation_normalizer.state(), trainer.goal_normalizer.state());
    let Resumption { acting, history, pending, .. } = resumption;
    let mut tensors = vec![
        f64s("figures", &stats_vector(&trainer.stats())),
        f64s("normalizer.observation.sum", &observation.sum),
        f64s("normalizer.observation.sum_of_squares", &observation.sum_of_squares),
        f64s("normalizer.goal.sum", &goal.sum),
        f64s("normalizer.goal.sum_of_squares", &goal.sum_of_squares),
    ];
    for (idx, pending) in pending.iter().enumerate() {
        let numbers = [stats_vector(&pending.stats).as_slice(), &[pending.wall_s]].concat();
        tensors.push(f64s(&format!("pending.{idx}.figures"), &numbers));
        let Counters { round, env_steps, episodes, updates, advice_spent, advice_queries } =
            pending.counters;
        let counts = [round, env_steps, episodes, updates, advice_spent, advice_queries];
        let bytes = counts.iter().flat_map(|count| count.to_le_bytes()).collect();
        tensors.push((format!("pending.{idx}.counters"), Dtype::U64, bytes));
    }
    tensors.extend([
        f32s("acting.actor", &acting.actor),
        f32s("acting.observation_mean", &acting.observation_mean),
        f32s("acting.observation_std", &acting.observation_std),
        f32s("acting.goal_mean", &acting.goal_mean),
        f32s("acting.goal_std", &acting.goal_std),
    ]);
    tensors.extend(acting.gate.iter().map(|gate| f32s(ACTING_GATE, &gate.critics)));
    let kept = [("best", &history.best), ("last", &history.last)];
    for (name, policy) in kept {
        tensors.extend(policy.iter().flat_map(|policy| policy_tensors(name, policy)));
    }
    for (idx, pending) in pending.iter().enumerate() {
        tensors.extend(policy_tensors(&format!("pending.{idx}"), &pending.policy));
    }
    tensors.push(("metrics".to_owned(), Dtype::U8, json_lines(&history.rows)));
    tensors
}

/// Returns the vectors that the trainer stores in the format of the file: nearly all of the state.
pub(super) fn large_tensors(trainer: &Trainer) -> Vec<Tensor<'_>> {
    let (parts, _) = trainer.replay.parts();
    let floats = trainer.tensors().into_iter().map(|(name, values)| Tensor {
        name,
        dtype: Dtype::F32,
        bytes: match values {
            Cow::Borrowed(values) => Cow::from(bytemuck::cast_slice(values)),
            Cow::Owned(values) => Cow::from(bytemuck::cast_slice(&values).to_vec()),
        },
    });
    let bytes = [
        ("replay.advised_arms", &parts.advised_arms),
        ("replay.contacts", &parts.contacts),
        ("replay.moved", &parts.moved),
    ];
    let bytes = bytes.map(|(name, bytes)| Tensor {
        name: name.to_owned(),
        dtype: Dtype::U8,
        bytes: bytes.into(),
    });
    floats.chain(bytes).collect()
}

fn policy_tensors(of: &str, policy: &Policy) -> Vec<OwnedTensor> {
    let (observation, goal) = (&policy.observation_normalizer, &policy.goal_normalizer);
    let named = |name: &str| format!("{of}.policy.{name}");
    vec![
        f32s(&named("actor"), &policy.actor),
        f32s(&named("critic"), &policy.critic),
        f32s(&named("observation_mean"), &observation.mean),
        f32s(&named("observation_std"), &observation.std),
        f32s(&named("goal_mean"), &goal.mean),
        f32s(&named("goal_std"), &goal.std),
        (named("metadata"), Dtype::U8, json_lines(&[&policy.metadata])),
    ]
}

const fn stats_vector(stats: &RoundStats) -> [f64; 5] {
    let RoundStats { critic_loss, actor_loss, mean_q, training_success, training_moved } = *stats;
    [critic_loss, actor_loss, mean_q, training_success, training_moved]
}

fn f32s(name: &str, values: &[f32]) -> OwnedTensor {
    (name.to_owned(), Dtype::F32, bytemuck::cast_slice(values).to_vec())
}

fn f64s(name: &str, values: &[f64]) -> OwnedTensor {
    (name.to_owned(), Dtype::F64, bytemuck::cast_slice(values).to_vec())
}

fn json_lines(values: &[impl serde::Serialize]) -> Vec<u8> {
    let line = |value| serde_json::to_string(value).expect("rows and names can be written");
    values.iter().map(|value| line(value) + "\n").collect::<String>().into_bytes()
}

/// Reads a state from the contents of a file. Errors describe the mismatch.
pub(super) struct Reader<'a> {
    pub(super) contents: Contents<'a>,
}

impl Reader<'_> {
    /// Restores the learning state of `trainer`, which is new, and returns the rest.
    pub(super) fn restore(&self, trainer: &mut Trainer) -> Result<Resumption, String> {
        self.check_run(trainer)?;
        trainer.counters = Counters {
            round: self.number("round", MAX_ROUNDS)?,
            env_steps: self.count("env_steps")?,
            episodes: self.count("episodes")?,
            updates: self.count("updates")?,
            advice_spent: self.count("advice_spent")?,
            advice_queries: match self.contents.metadata.contains_key(ADVICE_QUERIES) {
                true => self.count(ADVICE_QUERIES)?,
                false => 0,
            },
        };
        if let Some(horizon) = trainer.config.advice.horizon() {
            trainer.jump_start = Some(self.jump_start(horizon)?);
        }
        let [critic_loss, actor_loss, mean_q, training_success, training_moved] =
            self.numbers("figures")?;
        trainer.stats =
            RoundStats { critic_loss, actor_loss, mean_q, training_success, training_moved };
        self.restore_networks(trainer)?;
        trainer.observation_normalizer =
            self.normalizer("observation", trainer.task.n_observation())?;
        trainer.goal_normalizer = self.normalizer("goal", trainer.task.n_goal())?;
        self.restore_replay(trainer)?;
        let history = EvaluationHistory {
            rows: self.rows()?,
            best: self.stored_policy("best", trainer)?,
            last: self.stored_policy("last", trainer)?,
        };
        let wall_s = self.text("wall_s")?.parse().ok();
        Ok(Resumption {
            acting: self.acting(trainer)?,
            history,
            pending: self.pending(trainer)?,
            wall_s: wall_s.filter(is_time).ok_or("its wall_s is not a time")?,
            teacher_policy: self.contents.metadata.get(TEACHER_POLICY).cloned(),
            had_other_policy: self.contents.metadata.contains_key(OTHER_POLICY),
            account: self.account()?,
        })
    }

    fn account(&self) -> Result<Option<RenamedAccount>, String> {
        let Some(name) = self.contents.metadata.get(ACCOUNT_NAME) else { return Ok(None) };
        Ok(Some(RenamedAccount { name: name.clone(), budget: self.count(ACCOUNT_BUDGET)? }))
    }

    fn check_run(&self, trainer: &Trainer) -> Result<(), String> {
        let config = trainer.config();
        let expected = [
            ("task", config.task.clone()),
            ("arms", config.arms.to_string()),
            ("seed", config.seed.to_string()),
        ];
        expected.into_iter().try_for_each(|(key, expected)| match self.text(key)? {
            got if got == expected => Ok(()),
            got => Err(format!("its {key} is {got:?}, the run's is {expected:?}")),
        })
    }

    fn jump_start(&self, max_horizon: u32) -> Result<JumpStart, String> {
        let mut state = [0; 4];
        for (number, key) in state.iter_mut().zip(JUMP_START) {
            let value = self.number(key, u64::from(u32::MAX))?;
            *number = u32::try_from(value).map_err(|error| format!("{key}: {error}"))?;
        }
        let restored = JumpStart::from_state(max_horizon, state);
        restored
            .ok_or_else(|| format!("no run with horizon {max_horizon} has jump_start {state:?}"))
    }

    fn restore_networks(&self, trainer: &mut Trainer) -> Result<(), String> {
        let names = trainer.ddpg.state().map(|(name, _)| name);
        let vectors = names.iter().map(|name| Ok((*name, self.f32s(&format!("ddpg.{name}"))?)));
        let state: Vec<(String, Vec<f32>)> = vectors
            .map(|vector| vector.map(|(name, values)| (name.to_owned(), values)))
            .collect::<Result<_, String>>()?;
        let n_updates = self.count("ddpg.n_updates")?;
        let hint = "the run file gives ddpg.n_hidden or ddpg.n_hidden_layers another value than the run began with";
        trainer.ddpg.restore(&state, n_updates).map_err(|error| format!("{error}; {hint}"))?;
        let Some(ensemble) = &mut trainer.ensemble else { return Ok(()) };
        let names: Vec<String> = ensemble.state().into_iter().map(|(name, _)| name).collect();
        let vectors: Vec<Vec<f32>> = names
            .iter()
            .map(|name| self.f32s(&format!("ensemble.{name}")))
            .collect::<Result<_, _>>()?;
        ensemble.restore(&vectors, n_updates)
    }

    fn restore_replay(&self, trainer: &mut Trainer) -> Result<(), String> {
        let parts = ReplayParts {
            observations: self.f32s("replay.observations")?,
            goals: self.f32s("replay.goals")?,
            actions: self.f32s("replay.actions")?,
            advised_arms: self.bytes("replay.advised_arms", Dtype::U8)?.to_vec(),
            contacts: self.bytes("replay.contacts", Dtype::U8)?.to_vec(),
            moved: self.bytes("replay.moved", Dtype::U8)?.to_vec(),
        };
        let next = usize::try_from(self.count("replay.next")?).unwrap_or(usize::MAX);
        let capacity = trainer.config.replay.capacity_transitions;
        trainer.replay = ReplayBuffer::from_parts(&trainer.task, capacity, parts, next)
            .ok_or("its replay buffer is invalid or does not fit replay.capacity_transitions in the run file")?;
        Ok(())
    }

    fn normalizer(&self, of: &str, n: usize) -> Result<Normalizer, String> {
        let sum = self.f64s(&format!("normalizer.{of}.sum"))?;
        let sum_of_squares = self.f64s(&format!("normalizer.{of}.sum_of_squares"))?;
        let count = self.count(&format!("normalizer.{of}.count"))?;
        if sum.len() != n || sum_of_squares.len() != n {
            return Err(format!("the {of} normaliser has {} numbers, {n} are needed", sum.len()));
        }
        Ok(Normalizer::from_state(NormalizerState { count, sum, sum_of_squares }))
    }

    fn acting(&self, trainer: &Trainer) -> Result<PublishedActor, String> {
        let acting = PublishedActor {
            version: self.number("acting.version", trainer.counters.round)?,
            n_hidden: trainer.config.ddpg.n_hidden,
            n_hidden_layers: trainer.config.ddpg.n_hidden_layers,
            actor: self.f32s("acting.actor")?,
            observation_mean: self.f32s("acting.observation_mean")?,
            observation_std: self.f32s("acting.observation_std")?,
            goal_mean: self.f32s("acting.goal_mean")?,
            goal_std: self.f32s("acting.goal_std")?,
            gate: match trainer.publish().gate {
                Some(gate) => Some(PublishedGate { critics: self.f32s(ACTING_GATE)?, ..gate }),
                None => None,
            },
        };
        // Workers would refuse an unusable actor later; here the error names the checkpoint.
        match tandem_policy::Actor::new(&trainer.task, acting.clone()) {
            Ok(_) => Ok(acting),
            Err(error) => Err(format!("its acting parameters cannot be used: {error}")),
        }
    }

    fn pending(&self, trainer: &Trainer) -> Result<Vec<PendingEvaluation>, String> {
        let n: usize = usize::try_from(self.count("pending")?).unwrap_or(usize::MAX);
        if n > MAX_PENDING {
            return Err(format!("it has {n} pending evaluations"));
        }
        (0..n).map(|idx| self.pending_evaluation(&format!("pending.{idx}"), trainer)).collect()
    }

    fn pending_evaluation(
        &self,
        name: &str,
        trainer: &Trainer,
    ) -> Result<PendingEvaluation, String> {
        let counters = self.bytes(&format!("{name}.counters"), Dtype::U64)?;
        let counts: Vec<u64> = bytemuck::pod_collect_to_vec(counters);
        // Those of earlier versions do not have the queries.
        let counts = if counts.len() == 5 { [counts, vec![0]].concat() } else { counts };
        let [round, env_steps, episodes, updates, advice_spent, advice_queries] =
            exactly(&format!("{name}.counters"), counts)?;
        if round > trainer.counters.round {
            return Err(format!("{name} is of round {round}, which the run has not reached"));
        }
        let [critic_loss, actor_loss, mean_q, training_success, training_moved, wall_s] =
            self.numbers(&format!("{name}.figures"))?;
        let policy = self.stored_policy(name, trainer)?;
        Ok(PendingEvaluation {
            counters: Counters {
                round,
                env_steps,
                episodes,
                updates,
                advice_spent,
                advice_queries,
            },
            stats: RoundStats { critic_loss, actor_loss, mean_q, training_success, training_moved },
            wall_s,
            policy: policy.ok_or_else(|| format!("{name} has no policy"))?,
        })
    }

    fn rows(&self) -> Result<Vec<MetricsRow>, String> {
        let bytes = self.bytes("metrics", Dtype::U8)?;
        let lines = bytes.split(|byte| *byte == b'\n').filter(|line| !line.is_empty());
        lines
            .map(|line| serde_json::from_slice(line).map_err(|error| format!("metrics: {error}")))
            .collect()
    }

    /// Returns the policy stored under `of`, if there is one.
    fn stored_policy(&self, of: &str, trainer: &Trainer) -> Result<Option<Policy>, String> {
        let named = |name: &str| format!("{of}.policy.{name}");
        if self.contents.tensors.tensor(&named("actor")).is_err() {
            return Ok(None);
        }
        let metadata = serde_json::from_slice(self.bytes(&named("metadata"), Dtype::U8)?)
            .map_err(|error| format!("{of}: {error}"))?;
        let snapshot = |of: &str| -> Result<NormalizerSnapshot, String> {
            Ok(NormalizerSnapshot {
                mean: self.f32s(&named(&format!("{of}_mean")))?,
                std: self.f32s(&named(&format!("{of}_std")))?,
            })
        };
        let policy = Policy {
            actor: self.f32s(&named("actor"))?,
            critic: self.f32s(&named("critic"))?,
            observation_normalizer: snapshot("observation")?,
            goal_normalizer: snapshot("goal")?,
            ..trainer.policy(metadata)
        };
        match policy.check() {
            Ok(()) => Ok(Some(policy)),
            Err(error) => Err(format!("policy {of:?} cannot be used: {error}")),
        }
    }

    fn text(&self, key: &str) -> Result<&str, String> {
        let text = self.contents.metadata.get(key).map(String::as_str);
        text.ok_or_else(|| format!("no {key:?} in its metadata"))
    }

    fn count(&self, key: &str) -> Result<u64, String> {
        self.number(key, MAX_COUNT)
    }

    fn number(&self, key: &str, most: u64) -> Result<u64, String> {
        let text = self.text(key)?;
        let number = text.parse().ok().filter(|number| *number <= most);
        number.ok_or_else(|| format!("{key:?} is {text:?}, not 0 to {most}"))
    }

    fn numbers<const N: usize>(&self, name: &str) -> Result<[f64; N], String> {
        exactly(name, self.f64s(name)?)
    }

    fn bytes(&self, name: &str, dtype: Dtype) -> Result<&[u8], String> {
        let tensor = self.contents.tensors.tensor(name).map_err(|error| error.to_string())?;
        if tensor.dtype() == dtype {
            Ok(tensor.data())
        } else {
            Err(format!("tensor {name:?} is not {dtype:?}"))
        }
    }

    fn f32s(&self, name: &str) -> Result<Vec<f32>, String> {
        Ok(bytemuck::pod_collect_to_vec(self.bytes(name, Dtype::F32)?))
    }

    fn f64s(&self, name: &str) -> Result<Vec<f64>, String> {
        Ok(bytemuck::pod_collect_to_vec(self.bytes(name, Dtype::F64)?))
    }
}

fn exactly<T, const N: usize>(name: &str, values: Vec<T>) -> Result<[T; N], String> {
    values
        .try_into()
        .map_err(|values: Vec<T>| format!("{name:?} has {} numbers, not {N}", values.len()))
}

fn is_time(wall_s: &f64) -> bool {
    wall_s.is_finite() && *wall_s >= 0.0
}
