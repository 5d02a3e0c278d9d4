//! The teacher of a run: a policy file, ONNX models, or a policy on a server.

use std::path::{Path, PathBuf};

use tandem_core::TaskSpec;
use tandem_policy::Policy;
use tandem_rl::RunConfig;
use tandem_rl::config::Recipe;
use tandem_system::atomic_file;
use tandem_teacher::policy::{OnnxPolicy, is_onnx};
use tandem_teacher::{Error, Strategy, TeacherPolicy as _};

use super::policy_server::{PolicyServer, ServedPolicy};
use crate::exit::{Exit, Failed, OrExit as _};
use crate::policy_file;
use crate::service::{policy_address, teacher_failed};

/// File names of a teacher's copy: a policy file, the models of an actor and of a critic, or the address of a server.
const POLICY_COPY: &str = "teacher.safetensors";
const ACTOR_COPY: &str = "teacher.onnx";
const CRITIC_COPY: &str = "teacher-critic.onnx";
const SERVER_COPY: &str = "teacher.toml";
/// File with the digest of the run's teacher, by which a resumed run recognizes it.
const DIGEST: &str = "teacher.digest";

/// The policy of the teacher, as read from its files or described by its server.
pub(crate) struct TeacherFile {
    path: PathBuf,
    critic: Option<PathBuf>,
    digest: String,
    task: TaskSpec,
    has_values: bool,
    source: Source,
}

/// The kind of a teacher.
enum Source {
    Policy(Policy),
    /// ONNX models; whether the actor's metadata names the task.
    Models {
        names_task: bool,
    },
    Server(PolicyServer),
}

/// Returns the teacher of a new run: the one that is `named`, or the shipped one for the task.
pub(crate) fn path_of_new_run(named: Option<&Path>, config: &RunConfig) -> Result<PathBuf, Failed> {
    if let Some(path) = named {
        return Ok(path.to_owned());
    }
    let one_arm = config.task_spec().ok().and_then(|task| task.single_arm());
    let task = one_arm.as_ref().map_or(config.task.as_str(), TaskSpec::name);
    policy_file::shipped_teacher_of(config.recipe, task)
}

/// The copy of a teacher in a run directory.
pub(super) struct StoredTeacher {
    pub(super) path: PathBuf,
    pub(super) digest: String,
    server: Option<PolicyServer>,
}

impl TeacherFile {
    /// Loads a policy file, or the ONNX model of an actor with its critic, or asks a server for its policy.
    pub(crate) fn load(path: PathBuf, critic: Option<PathBuf>) -> Result<Self, Failed> {
        if is_onnx(&path) && policy_address(&path).is_none() {
            let models = OnnxPolicy::load(&path, critic.as_deref()).map_err(teacher_failed)?;
            let (digest, task) = (models.digest().to_owned(), models.task());
            let has_values = models.has_values();
            let source = Source::Models { names_task: models.names_task() };
            return Ok(Self { path, critic, digest, task, has_values, source });
        }
        if critic.is_some() {
            return Err(teacher_failed(Error::SurplusCritic));
        }
        if let Some(address) = policy_address(&path) {
            return ServedPolicy::of(address).map(Self::served);
        }
        let path = policy_file::file_of(&path)?.into_owned();
        let policy = policy_file::load(&path)?;
        let (digest, task) = (policy.digest(), policy.task.clone());
        let (has_values, source) = (policy.has_critic(), Source::Policy(policy));
        Ok(Self { path, critic, digest, task, has_values, source })
    }

    fn served(ServedPolicy { server, task, has_values }: ServedPolicy) -> Self {
        let (path, digest) = (PathBuf::from(&server.address), server.digest.clone());
        Self { path, critic: None, digest, task, has_values, source: Source::Server(server) }
    }

    /// Loads the copy in `directory`, if there is one. A server must still have the policy of the run.
    pub(super) fn copy_in(directory: &Path) -> Option<Result<Self, Failed>> {
        let [policy, actor, critic, server] =
            [POLICY_COPY, ACTOR_COPY, CRITIC_COPY, SERVER_COPY].map(|name| directory.join(name));
        if policy.exists() {
            return Some(Self::load(policy, None));
        }
        if server.exists() {
            let read = PolicyServer::read(&server).or_exit(Exit::Data, String::new);
            return Some(read.and_then(PolicyServer::connect).map(Self::served));
        }
        actor.exists().then(|| Self::load(actor, critic.exists().then_some(critic)))
    }

    /// Returns the intact copy in `directory`, if there is one. No server is asked.
    pub(super) fn stored_in(directory: &Path) -> Option<StoredTeacher> {
        let path = directory.join(SERVER_COPY);
        if path.exists() {
            let server = PolicyServer::read(&path).ok()?;
            return Some(StoredTeacher {
                path,
                digest: server.digest.clone(),
                server: Some(server),
            });
        }
        let Self { path, digest, .. } = Self::copy_in(directory)?.ok()?;
        Some(StoredTeacher { path, digest, server: None })
    }

    /// Writes the digest to `directory`, with the copy of a new run's teacher.
    pub(super) fn record_digest(&self, directory: &Path) -> Result<(), Failed> {
        let path = directory.join(DIGEST);
        let written = atomic_file::replace(&path, format!("{}\n", self.digest).as_bytes());
        written.or_cannot_write(|| format!("cannot write {}", path.display()))
    }

    /// Rejects a teacher with another digest than `directory` records. Runs of earlier versions record none.
    pub(super) fn check_recorded(&self, directory: &Path) -> Result<(), Failed> {
        let recorded = std::fs::read_to_string(directory.join(DIGEST)).unwrap_or_default();
        let recorded = recorded.trim();
        if recorded.is_empty() || recorded == self.digest {
            return Ok(());
        }
        Err(Failed::usage(format!(
            "{} is another policy than the run's teacher, whose digest is {recorded}: name that one with --teacher FILE, \
             or start a new run",
            self.path.display()
        )))
    }

    /// Returns whether `stored` is a copy of this teacher.
    pub(super) fn is_stored(&self, stored: &StoredTeacher) -> bool {
        self.digest == stored.digest && self.server() == stored.server.as_ref()
    }

    /// Returns the server of the policy, if it has one.
    pub(super) const fn server(&self) -> Option<&PolicyServer> {
        match &self.source {
            Source::Server(server) => Some(server),
            Source::Policy(_) | Source::Models { .. } => None,
        }
    }

    /// Refuses a teacher that cannot advise the run of `config`.
    pub(crate) fn check(&self, config: &RunConfig) -> Result<(), Failed> {
        let shown = self.path.display();
        if self.task.n_arms() != 1 {
            return Err(Failed::usage(format!(
                "{shown} drives {} arms: a teacher drives one",
                self.task.n_arms()
            )));
        }
        let one_arm = config.task_spec().or_exit(Exit::Usage, String::new)?.single_arm();
        let wanted = one_arm.as_ref().map_or(config.task.as_str(), TaskSpec::name);
        if self.task.name() != wanted {
            let needed = match wanted == config.task {
                true => String::new(),
                false => format!(", which needs one for {wanted}"),
            };
            return Err(Failed::usage(format!(
                "{shown} is a teacher for {}, the run is for {}{needed}{}",
                self.task.name(),
                config.task,
                self.advice_on_task()
            )));
        }
        if let Some(difference) = one_arm.and_then(|task| task.difference(&self.task)) {
            return Err(Failed::usage(format!(
                "{shown} is a teacher for another task {:?} than the run's: {difference}",
                config.task
            )));
        }
        let is_policy_file = matches!(self.source, Source::Policy(_));
        if config.advice.starts_from_teacher() && !(is_policy_file && self.has_values) {
            return Err(Failed::usage(format!(
                "{shown}: a run of strategy {} starts from a policy file with a critic; `tandem policy import` converts \
                 ONNX models of actor and critic",
                config.advice.strategy
            )));
        }
        match config.advice.strategy.parse::<Strategy>() {
            Ok(strategy) if strategy.needs_values() && !self.has_values => {
                Err(Failed::new(Exit::Usage, Error::NoValues { strategy })
                    .context(shown.to_string()))
            }
            _ => Ok(()),
        }
    }

    /// Returns what to do about a model that names no task, to be appended to a refusal.
    const fn advice_on_task(&self) -> &'static str {
        match self.source {
            Source::Models { names_task: false } => {
                ": its file names no task and was taken for the one that its vectors fit, so add the metadata \"task\" \
                 and \"n_arms\", or convert it with `tandem policy import`, which takes the task"
            }
            _ => "",
        }
    }

    /// Returns a remark if the run has the paper's recipe and the teacher was trained with another one.
    pub(super) fn other_recipe(&self, config: &RunConfig) -> Option<String> {
        let Source::Policy(policy) = &self.source else { return None };
        let trained_with = policy.metadata.get("recipe")?;
        if config.recipe != Recipe::Paper || trained_with == Recipe::Paper.name() {
            return None;
        }
        Some(format!(
            "the teacher {} was trained with recipe {trained_with:?}, whose values have another range: for the paper's, \
             train one for the same task with `tandem train --arms 1 --recipe paper` and name it with --teacher",
            self.path.display()
        ))
    }

    /// Returns the file of the policy or of the actor's model, or the address of the policy's server.
    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    pub(super) fn digest(&self) -> &str {
        &self.digest
    }

    /// Returns the path of the copy in `directory`.
    pub(super) fn copy_path(&self, directory: &Path) -> PathBuf {
        directory.join(match self.source {
            Source::Policy(_) => POLICY_COPY,
            Source::Models { .. } => ACTOR_COPY,
            Source::Server(_) => SERVER_COPY,
        })
    }

    /// Returns the path of the critic's copy in `directory`, if the critic has a file.
    pub(super) fn critic_copy_path(&self, directory: &Path) -> Option<PathBuf> {
        self.critic.as_ref().map(|_| directory.join(CRITIC_COPY))
    }

    /// Copies the files to `directory`, in place of the copy of any other teacher.
    pub(super) fn copy_to(&self, directory: &Path) -> Result<(), Failed> {
        let copies = [
            (Some(&self.path), Some(self.copy_path(directory))),
            (self.critic.as_ref(), self.critic_copy_path(directory)),
        ];
        let copies: Vec<_> = copies.into_iter().filter_map(|(from, to)| from.zip(to)).collect();
        for name in [POLICY_COPY, ACTOR_COPY, CRITIC_COPY, SERVER_COPY] {
            let other = directory.join(name);
            if copies.iter().all(|(from, to)| *to != other && **from != other) && other.exists() {
                let removed = std::fs::remove_file(&other);
                removed.or_cannot_write(|| format!("cannot remove {}", other.display()))?;
            }
        }
        if let Source::Server(server) = &self.source {
            return server.write(&self.copy_path(directory));
        }
        for (from, to) in copies {
            let bytes = std::fs::read(from);
            let bytes = bytes.or_exit(Exit::Data, || format!("cannot read {}", from.display()))?;
            let written = atomic_file::replace(&to, &bytes);
            written.or_cannot_write(|| format!("cannot write {}", to.display()))?;
        }
        Ok(())
    }

    /// Writes the policy as it was read to `directory`.
    pub(super) fn write_to(&self, directory: &Path) -> Result<(), Failed> {
        match &self.source {
            Source::Policy(policy) => {
                let saved = policy.save(&self.copy_path(directory));
                saved.or_exit(Exit::TryAgain, String::new)
            }
            Source::Models { .. } | Source::Server(_) => self.copy_to(directory),
        }
    }
}
