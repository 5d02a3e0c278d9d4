//! A teacher whose networks are ONNX models.

use std::path::Path;

use tandem_core::TaskSpec;
use tandem_onnx::binding::{Source, check_pair, names_task, task_of};
use tandem_onnx::{BoundNetwork, Error as OnnxError, Model, ModelError, Role};

use super::TeacherPolicy;
use crate::error::Error;

/// A policy for one arm from ONNX models: an actor and, unless it has no values, a critic.
///
/// Actions are clipped to [−1, 1]. The digest is the SHA-256 of the actor's file; with a critic, that of both files'
/// digests.
pub struct OnnxPolicy {
    digest: String,
    names_task: bool,
    actor: BoundNetwork,
    critic: Option<BoundNetwork>,
}

impl OnnxPolicy {
    /// Loads the models of an actor and of its critic.
    ///
    /// The task is the one in the actor's metadata, or the one that its inputs and outputs fit.
    ///
    /// # Errors
    /// When a file cannot be read, its graph is not supported, the models are not for one arm and the same task, or
    /// their metadata says that they are parts of different policies.
    pub fn load(actor: &Path, critic: Option<&Path>) -> Result<Self, Error> {
        let model = Model::load(actor)?;
        let task = task_of(&model, Role::Actor).map_err(|source| refused(actor, source))?;
        let bound = BoundNetwork::new(&model, Role::Actor, &task);
        let bound = bound.map_err(|source| refused(actor, source))?;
        let n_arms = bound.task().n_arms();
        if n_arms != 1 {
            return Err(Error::NotOneArm { policy: shown(actor), n_arms });
        }
        let names_task = names_task(&model);
        let Some(path) = critic else {
            return Ok(Self { digest: model.digest, names_task, actor: bound, critic: None });
        };
        let critic_model = Model::load(path)?;
        let checked = check_pair(&model, &critic_model);
        checked.map_err(|source| refused(path, source))?;
        let critic = BoundNetwork::new(&critic_model, Role::Critic, task);
        let critic = critic.map_err(|source| refused(path, source))?;
        check_critic(path, &critic)?;
        let digest = tandem_onnx::model::digest_of(&[&model.digest, &critic_model.digest]);
        Ok(Self { digest, names_task, actor: bound, critic: Some(critic) })
    }

    /// Returns true if the actor's metadata names the task. Otherwise it is the one that the vectors fit.
    #[must_use]
    pub const fn names_task(&self) -> bool {
        self.names_task
    }
}

/// Refuses a network that takes no action, as an actor's, or has several values.
fn check_critic(path: &Path, critic: &BoundNetwork) -> Result<(), Error> {
    let n_outputs = critic.network().n_output;
    if !critic.sources().iter().any(|source| matches!(source, Source::Action(_))) {
        return Err(Error::NotACritic { path: path.to_owned(), n_outputs });
    }
    match n_outputs {
        1 => Ok(()),
        n_values => Err(Error::NotOneValue { policy: shown(path), n_values }),
    }
}

fn shown(path: &Path) -> String {
    format!("{path:?}")
}

fn refused(path: &Path, source: ModelError) -> Error {
    OnnxError::Refused { path: path.to_owned(), source: Box::new(source) }.into()
}

impl TeacherPolicy for OnnxPolicy {
    fn task(&self) -> TaskSpec {
        self.actor.task().clone()
    }

    fn digest(&self) -> &str {
        &self.digest
    }

    fn has_values(&self) -> bool {
        self.critic.is_some()
    }

    fn act(&mut self, observations: &[f32], goals: &[f32], actions: &mut [f32]) {
        self.actor.run(observations, goals, &[], actions);
        for component in actions {
            *component = component.clamp(-1.0, 1.0);
        }
    }

    fn q(&mut self, observations: &[f32], goals: &[f32], actions: &[f32], q: &mut [f32]) {
        match &mut self.critic {
            Some(critic) => critic.run(observations, goals, actions, q),
            None => q.fill(0.0),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use tandem_policy::Policy;

    use super::*;
    use crate::policy::{OneArmPolicy, load};

    fn policy_file(name: &str) -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("policies").join(name)
    }

    /// Writes the models of a shipped policy and returns their paths.
    fn exported(directory: &Path, name: &str) -> [PathBuf; 2] {
        let policy = Policy::load(&policy_file(name)).unwrap();
        let paths = ["actor.onnx", "critic.onnx"].map(|name| directory.join(name));
        std::fs::write(&paths[0], tandem_onnx::export::actor(&policy).unwrap()).unwrap();
        std::fs::write(&paths[1], tandem_onnx::export::critic(&policy).unwrap()).unwrap();
        paths
    }

    #[test]
    fn an_exported_teacher_acts_and_values_as_its_policy_file() {
        const N_ROWS: usize = 3;
        let directory = tempfile::tempdir().unwrap();
        let [actor, critic] = exported(directory.path(), "teacher-push-classic.safetensors");
        let mut file =
            OneArmPolicy::load(&policy_file("teacher-push-classic.safetensors")).unwrap();
        let mut models = load(&actor, Some(&critic)).unwrap();
        let mut alone = load(&actor, None).unwrap();
        assert_eq!(models.task(), file.task());
        assert!(models.has_values() && file.has_values() && !alone.has_values());
        let digests = [file.digest(), models.digest(), alone.digest()];
        assert!(digests[0] != digests[1] && digests[1] != digests[2], "{digests:?}");

        let observations: Vec<f32> =
            (0..N_ROWS * 28).map(|i| (i as f32 * 0.7).sin() * 0.2).collect();
        let goals: Vec<f32> = (0..N_ROWS * 3).map(|i| (i as f32 * 1.3).cos() * 0.1).collect();
        let run = |policy: &mut dyn TeacherPolicy| {
            let (mut actions, mut q) = (vec![0.0; N_ROWS * 3], vec![0.0; N_ROWS]);
            policy.act(&observations, &goals, &mut actions);
            policy.q(&observations, &goals, &actions, &mut q);
            [actions, q]
        };
        let (expected, got) = (run(&mut file), run(&mut *models));
        for (got, expected) in got.concat().iter().zip(expected.concat()) {
            assert!((got - expected).abs() < 1e-5 * expected.abs().max(1.0), "{got}, {expected}");
        }
        assert_eq!(run(&mut *alone), [got[0].clone(), vec![0.0; N_ROWS]]);
    }

    #[test]
    fn models_that_cannot_teach_are_refused() {
        let directory = tempfile::tempdir().unwrap();
        let [actor, critic] = exported(directory.path(), "student-push-classic.safetensors");
        let refusal = |policy: &Path, critic: Option<&Path>| {
            let error = load(policy, critic).err().expect("must be refused");
            tandem_core::text::error_chain(&error)
        };
        assert_eq!(
            refusal(&actor, Some(&critic)),
            format!("a teacher needs a policy that drives 1 arm, {actor:?} drives 2")
        );
        assert_eq!(
            refusal(&actor, None),
            format!("a teacher needs a policy that drives 1 arm, {actor:?} drives 2")
        );
        let two_arms = policy_file("student-push-classic.safetensors");
        assert_eq!(
            refusal(&two_arms, None),
            format!("a teacher needs a policy that drives 1 arm, {two_arms:?} drives 2")
        );
        assert_eq!(
            refusal(&policy_file("teacher-push-classic.safetensors"), Some(&critic)),
            "a critic is given apart only for an ONNX model: a policy file contains its own"
        );
        let other = tempfile::tempdir().unwrap();
        let [shared, shared_critic] = exported(other.path(), "teacher-push.safetensors");
        let mixed = refusal(&shared, Some(&critic));
        assert!(
            mixed.ends_with(
                "its metadata says push with 2 arms, the actor's says shared-push with 1 arm"
            ),
            "{mixed}"
        );
        assert_eq!(
            refusal(&shared, Some(&shared)),
            format!(
                "{shared:?} is not a critic: it takes no action, as an actor does, and returns 3 numbers"
            )
        );
        let mut policy = Policy::load(&policy_file("teacher-push.safetensors")).unwrap();
        policy.critic[0] += 1.0;
        std::fs::write(&shared_critic, tandem_onnx::export::critic(&policy).unwrap()).unwrap();
        let mixed = refusal(&shared, Some(&shared_critic));
        assert!(mixed.contains("it belongs to another policy than the actor"), "{mixed}");
        let swapped = refusal(&critic, Some(&actor));
        assert!(
            swapped.contains("critic.onnx\" is not a usable ONNX model: output \"value\""),
            "{swapped}"
        );
        let torn = directory.path().join("torn.ONNX");
        std::fs::write(&torn, &std::fs::read(&actor).unwrap()[..5000]).unwrap();
        assert!(refusal(&torn, None).ends_with("it is not a complete ONNX file"));
        assert!(
            refusal(&directory.path().join("none.onnx"), None).contains("cannot read ONNX file")
        );
    }
}
