//! The teacher's policy.

mod onnx;

use std::path::Path;

use tandem_core::TaskSpec;
use tandem_policy::{Actor, Critic, Policy};

use crate::batch::Batch;
use crate::error::Error;
use crate::remote_policy::{RemoteError, RemotePolicy};

pub use onnx::OnnxPolicy;

/// Extension of the files that hold an ONNX model.
const ONNX_EXTENSION: &str = "onnx";

/// A policy for one arm with an actor and, unless it has no values, a critic. Rows are states of one arm. Callers pass
/// vectors whose lengths fit the [task](Self::task).
pub trait TeacherPolicy: Send {
    /// Returns the task, of one arm.
    fn task(&self) -> TaskSpec;

    /// Returns the text that identifies the policy: the SHA-256, hexadecimal, of its parameters or files.
    fn digest(&self) -> &str;

    /// Returns true if the policy values actions. If not, the teacher refuses strategies that compare values, and does
    /// not call [`q`](Self::q).
    fn has_values(&self) -> bool {
        true
    }

    /// Writes the actions of `π_tr`, in [−1, 1], shape `[n, n_action]`, for `observations`, shape `[n, n_observation]`,
    /// and `goals`, shape `[n, n_goal]`.
    fn act(&mut self, observations: &[f32], goals: &[f32], actions: &mut [f32]);

    /// Writes the values of `Q_tr`, shape `[n]`, of `actions`, shape `[n, n_action]`, in the same states.
    fn q(&mut self, observations: &[f32], goals: &[f32], actions: &[f32], q: &mut [f32]);
}

/// The policy that an advisor consults.
pub enum AnyPolicy {
    /// A policy in this process.
    Local(Box<dyn TeacherPolicy>),
    /// A policy in another process.
    Remote(RemotePolicy),
}

impl AnyPolicy {
    /// Returns the task, of one arm.
    #[must_use]
    pub fn task(&self) -> TaskSpec {
        match self {
            Self::Local(policy) => policy.task(),
            Self::Remote(policy) => policy.task().clone(),
        }
    }

    /// Returns the text that identifies the policy.
    #[must_use]
    pub fn digest(&self) -> &str {
        match self {
            Self::Local(policy) => policy.digest(),
            Self::Remote(policy) => policy.digest(),
        }
    }

    /// Returns true if the policy values actions.
    #[must_use]
    pub fn has_values(&self) -> bool {
        match self {
            Self::Local(policy) => policy.has_values(),
            Self::Remote(policy) => policy.has_values(),
        }
    }

    /// Fills in the answers of `batch`. Without values, all values are 0.
    ///
    /// # Errors
    /// When the policy is in another process, which does not answer, or not as it should.
    pub(crate) fn evaluate(&mut self, batch: &mut Batch) -> Result<(), RemoteError> {
        match self {
            Self::Local(policy) => evaluate_here(policy.as_mut(), batch),
            Self::Remote(policy) => policy.evaluate(batch)?,
        }
        Ok(())
    }
}

impl From<Box<dyn TeacherPolicy>> for AnyPolicy {
    fn from(policy: Box<dyn TeacherPolicy>) -> Self {
        Self::Local(policy)
    }
}

impl<P: TeacherPolicy + 'static> From<Box<P>> for AnyPolicy {
    fn from(policy: Box<P>) -> Self {
        Self::Local(policy)
    }
}

impl From<RemotePolicy> for AnyPolicy {
    fn from(policy: RemotePolicy) -> Self {
        Self::Remote(policy)
    }
}

/// Runs the actor once on all states, and the critic once on all states with both actions.
fn evaluate_here(policy: &mut dyn TeacherPolicy, batch: &mut Batch) {
    batch.actions.clear();
    batch.actions.resize(batch.student_actions.len(), 0.0);
    policy.act(&batch.observations, &batch.goals, &mut batch.actions);
    batch.actions.extend_from_slice(&batch.student_actions);
    batch.q.clear();
    batch.q.resize(2 * batch.n_rows, 0.0);
    if policy.has_values() {
        batch.observations.extend_from_within(..);
        batch.goals.extend_from_within(..);
        policy.q(&batch.observations, &batch.goals, &batch.actions, &mut batch.q);
    }
}

/// Loads the policy at `policy`, of the kind that its extension says: an ONNX model of an actor, with the model of its
/// critic in `critic`, or else a policy file.
///
/// # Errors
/// When a file cannot be read or is not a valid policy for one arm, or `critic` is given with a policy file.
pub fn load(policy: &Path, critic: Option<&Path>) -> Result<Box<dyn TeacherPolicy>, Error> {
    if is_onnx(policy) {
        return Ok(Box::new(OnnxPolicy::load(policy, critic)?));
    }
    match critic {
        Some(_) => Err(Error::SurplusCritic),
        None => Ok(Box::new(OneArmPolicy::load(policy)?)),
    }
}

/// Returns true if the extension of `path` is that of an ONNX model.
#[must_use]
pub fn is_onnx(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case(ONNX_EXTENSION))
}

/// A loaded policy for one arm.
pub struct OneArmPolicy {
    digest: String,
    has_critic: bool,
    actor: Actor,
    critic: Critic,
}

impl OneArmPolicy {
    /// Loads the policy file at `path`.
    ///
    /// # Errors
    /// When the file is not a valid policy, or [`Self::new`] refuses the policy.
    pub fn load(path: &Path) -> Result<Self, Error> {
        Self::of(&Policy::load(path)?, format!("{path:?}"))
    }

    /// Prepares `policy` for inference.
    ///
    /// # Errors
    /// When the policy is not for one arm or is invalid, or its critic has several values.
    pub fn new(policy: &Policy) -> Result<Self, Error> {
        Self::of(policy, "this one".to_owned())
    }

    /// Prepares a policy that errors call `name`.
    fn of(policy: &Policy, name: String) -> Result<Self, Error> {
        let (n_arms, n_values) = (policy.task.n_arms(), policy.n_heads);
        if n_arms != 1 {
            return Err(Error::NotOneArm { policy: name, n_arms });
        }
        if n_values != 1 {
            return Err(Error::NotOneValue { policy: name, n_values });
        }
        policy.check()?;
        Ok(Self {
            digest: policy.digest(),
            has_critic: policy.has_critic(),
            actor: policy.actor()?,
            critic: policy.critic()?,
        })
    }
}

impl TeacherPolicy for OneArmPolicy {
    fn task(&self) -> TaskSpec {
        self.actor.task().clone()
    }

    fn digest(&self) -> &str {
        &self.digest
    }

    fn has_values(&self) -> bool {
        self.has_critic
    }

    fn act(&mut self, observations: &[f32], goals: &[f32], actions: &mut [f32]) {
        self.actor.act(observations, goals, actions);
    }

    fn q(&mut self, observations: &[f32], goals: &[f32], actions: &[f32], q: &mut [f32]) {
        self.critic.q(observations, goals, actions, q);
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use tandem_core::{Layout, Task};
    use tandem_policy::NormalizerSnapshot;

    use super::*;

    /// Returns a policy whose networks have one hidden unit and the same value for all weights.
    fn policy(n_arms: usize, n_heads: usize, weight: f32) -> Policy {
        let layout = Layout::new(Task::Push, n_arms);
        let identity = |n| NormalizerSnapshot { mean: vec![0.0; n], std: vec![1.0; n] };
        let mut policy = Policy {
            n_hidden: 1,
            n_hidden_layers: 1,
            n_heads,
            actor: Vec::new(),
            critic: Vec::new(),
            observation_normalizer: identity(layout.n_observation()),
            goal_normalizer: identity(layout.n_goal()),
            task: layout.into(),
            metadata: BTreeMap::new(),
        };
        policy.actor = vec![weight; policy.actor_shape().n_parameters()];
        policy.critic = vec![weight; policy.critic_shape().n_parameters()];
        policy
    }

    #[test]
    fn a_policy_for_one_arm_acts_and_values_row_by_row() {
        let weight = 1.0 / 64.0;
        let mut teacher = OneArmPolicy::new(&policy(1, 1, weight)).unwrap();
        assert_eq!(teacher.task(), TaskSpec::built_in(Task::Push, 1));
        assert_eq!(teacher.digest(), policy(1, 1, weight).digest());

        let (observations, goals) = ([[0.0; 28], [1.0; 28]].concat(), [0.0; 6]);
        let (mut actions, mut q) = ([0.0; 6], [0.0; 2]);
        teacher.act(&observations, &goals, &mut actions);
        teacher.q(&observations, &goals, &[0.0, 0.0, 0.0, 1.0, 1.0, 1.0], &mut q);

        let raw_of = |sum: f32| (sum * weight + weight) * weight + weight;
        let near = |got: f32, expected: f32| {
            assert!((got - expected).abs() < 1e-6, "{got} is not {expected}");
        };
        near(actions[0], raw_of(0.0).tanh());
        near(actions[5], raw_of(28.0).tanh());
        near(q[0], raw_of(0.0));
        near(q[1], raw_of(28.0 + 3.0));
    }

    #[test]
    fn only_a_policy_for_one_arm_can_teach() {
        let refusal = |n_arms, n_heads| {
            OneArmPolicy::new(&policy(n_arms, n_heads, 0.5)).err().unwrap().to_string()
        };
        assert_eq!(refusal(2, 1), "a teacher needs a policy that drives 1 arm, this one drives 2");
        assert_eq!(
            refusal(1, 2),
            "a teacher needs a critic that returns 1 value, that of this one returns 2"
        );
    }

    #[test]
    fn an_invalid_policy_is_refused() {
        let mut short = policy(1, 1, 0.5);
        short.critic.pop();
        let refused = OneArmPolicy::new(&short).err().unwrap();
        assert!(matches!(refused, Error::Policy(_)), "{refused:?}");
    }
}
