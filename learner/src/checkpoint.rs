//! The whole learning state in one file, written whole or not at all.
//!
//! A checkpoint is a safetensors file `checkpoint/{round}.safetensors`: every tensor of the state, and metadata with
//! the counters and the state's digest, which is checked on load. The former one stays until the new one is whole.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use safetensors::{Dtype, SafeTensors, tensor::TensorView};
use tandem_core::work::PublishedActor;
use tandem_policy::{Normalizer, NormalizerParts};

use crate::config::{ConfigError, RunConfig};
use crate::replay::{ReplayBuffer, ReplayParts};
use crate::trainer::{Counters, Trainer};

/// Version of the file's layout.
const FORMAT: &str = "1";

/// What a checkpoint holds beside the trainer.
#[derive(Debug, Clone, PartialEq)]
pub struct Resumption {
    /// The parameters with which the round after the checkpoint is played.
    pub acting: PublishedActor,
    /// Seconds that the run has taken so far.
    pub wall_s: f64,
}

/// Why a checkpoint could not be written or read.
#[derive(Debug, thiserror::Error)]
pub enum CheckpointError {
    /// The file system refused.
    #[error("cannot {action} checkpoint {path:?}")]
    Io {
        /// What was attempted.
        action: &'static str,
        /// On which file.
        path: PathBuf,
        /// Why not.
        source: std::io::Error,
    },
    /// Not a whole checkpoint.
    #[error("checkpoint {path:?} is damaged: {what}")]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        what: String,
    },
    /// There is none.
    #[error("no checkpoint in {0:?}")]
    None(PathBuf),
    /// The run file cannot be used.
    #[error(transparent)]
    Config(#[from] ConfigError),
}

/// Writes a checkpoint into `directory` and removes all but the newest `keep`. Gives its path and
/// the digest of the state.
///
/// # Errors
/// When the file system refuses; former checkpoints are then untouched.
pub fn save(
    directory: &Path,
    trainer: &Trainer,
    resumption: &Resumption,
    keep: usize,
) -> Result<(PathBuf, String), CheckpointError> {
    let path = directory.join(format!("{:08}.safetensors", trainer.counters().round));
    let unfinished = path.with_extension("tmp");
    let io = |action: &'static str, path: &Path| {
        let path = path.to_owned();
        move |source| CheckpointError::Io { action, path, source }
    };
    fs::create_dir_all(directory).map_err(io("create the directory of", &path))?;
    let owned = small_tensors(trainer, resumption);
    let mut tensors = view_all(&owned);
    let (parts, _) = trainer.replay.parts();
    let state = trainer.tensors();
    tensors.extend(
        state.iter().map(|(name, values)| view(name, Dtype::F32, bytemuck::cast_slice(values))),
    );
    tensors.push(view("replay.advised_arms", Dtype::U8, &parts.advised_arms));
    tensors.push(view("replay.moved", Dtype::U8, &parts.moved));
    let digest = trainer.digest();
    let metadata = metadata(trainer, resumption, &digest).into_iter().collect();
    let written = safetensors::serialize_to_file(tensors, Some(metadata), &unfinished)
        .map_err(|error| io("write", &path)(std::io::Error::other(error)))
        .and_then(|()| sync(&unfinished).map_err(io("write", &path)))
        .and_then(|()| fs::rename(&unfinished, &path).map_err(io("write", &path)));
    if written.is_err() {
        drop(fs::remove_file(&unfinished));
    }
    written?;
    let former = list(directory);
    for old in former.iter().rev().skip(keep) {
        fs::remove_file(old).map_err(io("remove the old", old))?;
    }
    Ok((path, digest))
}

/// The checkpoints in `directory`, oldest first.
#[must_use]
pub fn list(directory: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(directory).into_iter().flatten().flatten().map(|entry| entry.path());
    let mut paths: Vec<PathBuf> =
        entries.filter(|path| path.extension().is_some_and(|e| e == "safetensors")).collect();
    paths.sort();
    paths
}

/// Restores the newest checkpoint in `directory` of a run with `config`.
///
/// # Errors
/// When there is none, or it is damaged or of another run's shape; the message names the file and the former one.
pub fn load_newest(
    directory: &Path,
    config: &RunConfig,
) -> Result<(Trainer, Resumption), CheckpointError> {
    let mut paths = list(directory);
    let newest = paths.pop().ok_or_else(|| CheckpointError::None(directory.to_owned()))?;
    load(&newest, config).map_err(|error| match (error, paths.pop()) {
        (CheckpointError::Damaged { path, what }, Some(former)) => {
            let what = format!("{what}; remove it to go on from {former:?}");
            CheckpointError::Damaged { path, what }
        }
        (error, _) => error,
    })
}

/// Restores one checkpoint.
///
/// # Errors
/// When it cannot be read, is damaged, or is of another run's shape.
pub fn load(path: &Path, config: &RunConfig) -> Result<(Trainer, Resumption), CheckpointError> {
    let damaged = |what: String| CheckpointError::Damaged { path: path.to_owned(), what };
    let bytes = fs::read(path).map_err(|source| CheckpointError::Io {
        action: "read",
        path: path.to_owned(),
        source,
    })?;
    let (_, header) =
        SafeTensors::read_metadata(&bytes).map_err(|error| damaged(error.to_string()))?;
    let metadata: BTreeMap<String, String> =
        header.metadata().clone().unwrap_or_default().into_iter().collect();
    let tensors = SafeTensors::deserialize(&bytes).map_err(|error| damaged(error.to_string()))?;
    let reader = Reader { metadata, tensors };
    let mut trainer = Trainer::new(config.clone())?;
    reader.check_format().and_then(|()| reader.restore(&mut trainer)).map_err(damaged)?;
    let digest = trainer.digest();
    if reader.text("digest").map_err(damaged)? != digest {
        return Err(damaged("its digest does not match its contents".to_owned()));
    }
    let resumption = reader.resumption(config).map_err(damaged)?;
    Ok((trainer, resumption))
}

struct Reader<'a> {
    metadata: BTreeMap<String, String>,
    tensors: SafeTensors<'a>,
}

impl Reader<'_> {
    fn check_format(&self) -> Result<(), String> {
        let format = self.text("format")?;
        if format == FORMAT { Ok(()) } else { Err(format!("format {format} is not {FORMAT}")) }
    }

    fn text(&self, key: &str) -> Result<&str, String> {
        self.metadata
            .get(key)
            .map(String::as_str)
            .ok_or_else(|| format!("no {key:?} in its metadata"))
    }

    fn number<T: std::str::FromStr>(&self, key: &str) -> Result<T, String> {
        let text = self.text(key)?;
        text.parse().ok().ok_or_else(|| format!("{key:?} is {text:?}, not a number"))
    }

    fn bytes(&self, name: &str, dtype: Dtype) -> Result<&[u8], String> {
        let tensor = self.tensors.tensor(name).map_err(|error| error.to_string())?;
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

    fn restore(&self, trainer: &mut Trainer) -> Result<(), String> {
        trainer.counters = Counters {
            round: self.number("round")?,
            env_steps: self.number("env_steps")?,
            episodes: self.number("episodes")?,
            updates: self.number("updates")?,
            advice_spent: self.number("advice_spent")?,
        };
        let state: Vec<(String, Vec<f32>)> = trainer
            .ddpg
            .state()
            .into_iter()
            .map(|(name, _)| Ok((name.to_owned(), self.f32s(&format!("ddpg.{name}"))?)))
            .collect::<Result<_, String>>()?;
        trainer
            .ddpg
            .restore(&state, self.number("ddpg.n_updates")?)
            .map_err(|error| error.to_string())?;
        trainer.observation_normalizer =
            self.normalizer("observation", trainer.layout.n_observation())?;
        trainer.goal_normalizer = self.normalizer("goal", trainer.layout.n_goal())?;
        let parts = ReplayParts {
            observations: self.f32s("replay.observations")?,
            goals: self.f32s("replay.goals")?,
            actions: self.f32s("replay.actions")?,
            advised_arms: self.bytes("replay.advised_arms", Dtype::U8)?.to_vec(),
            moved: self.bytes("replay.moved", Dtype::U8)?.to_vec(),
        };
        let capacity = trainer.config.replay.capacity_transitions;
        trainer.replay =
            ReplayBuffer::from_parts(trainer.layout, capacity, parts, self.number("replay.next")?)
                .ok_or("its replay buffer does not fit the run file")?;
        Ok(())
    }

    fn normalizer(&self, of: &str, n: usize) -> Result<Normalizer, String> {
        let sum = self.f64s(&format!("normalizer.{of}.sum"))?;
        let sum_of_squares = self.f64s(&format!("normalizer.{of}.sum_of_squares"))?;
        let count = self.number(&format!("normalizer.{of}.count"))?;
        if sum.len() != n || sum_of_squares.len() != n {
            return Err(format!("the {of} normaliser has {} numbers, {n} are needed", sum.len()));
        }
        Ok(Normalizer::from_parts(NormalizerParts { count, sum, sum_of_squares }))
    }

    fn resumption(&self, config: &RunConfig) -> Result<Resumption, String> {
        let acting = PublishedActor {
            version: self.number("acting.version")?,
            n_hidden: config.ddpg.n_hidden,
            n_hidden_layers: config.ddpg.n_hidden_layers,
            actor: self.f32s("acting.actor")?,
            observation_mean: self.f32s("acting.observation_mean")?,
            observation_std: self.f32s("acting.observation_std")?,
            goal_mean: self.f32s("acting.goal_mean")?,
            goal_std: self.f32s("acting.goal_std")?,
        };
        Ok(Resumption { acting, wall_s: self.number("wall_s")? })
    }
}

fn metadata(trainer: &Trainer, resumption: &Resumption, digest: &str) -> BTreeMap<String, String> {
    let Counters { round, env_steps, episodes, updates, advice_spent } = trainer.counters();
    let (_, next) = trainer.replay.parts();
    let entries = [
        ("format", FORMAT.to_owned()),
        ("digest", digest.to_owned()),
        ("round", round.to_string()),
        ("env_steps", env_steps.to_string()),
        ("episodes", episodes.to_string()),
        ("updates", updates.to_string()),
        ("advice_spent", advice_spent.to_string()),
        ("ddpg.n_updates", trainer.ddpg.n_updates().to_string()),
        ("normalizer.observation.count", trainer.observation_normalizer.parts().count.to_string()),
        ("normalizer.goal.count", trainer.goal_normalizer.parts().count.to_string()),
        ("replay.next", next.to_string()),
        ("acting.version", resumption.acting.version.to_string()),
        ("wall_s", resumption.wall_s.to_string()),
    ];
    entries.into_iter().map(|(key, value)| (key.to_owned(), value)).collect()
}

type OwnedTensor = (&'static str, Dtype, Vec<u8>);

fn small_tensors(trainer: &Trainer, resumption: &Resumption) -> Vec<OwnedTensor> {
    let f32s = |name, values: &[f32]| (name, Dtype::F32, bytemuck::cast_slice(values).to_vec());
    let f64s = |name, values: &[f64]| (name, Dtype::F64, bytemuck::cast_slice(values).to_vec());
    let (observation, goal) =
        (trainer.observation_normalizer.parts(), trainer.goal_normalizer.parts());
    let acting = &resumption.acting;
    vec![
        f64s("normalizer.observation.sum", &observation.sum),
        f64s("normalizer.observation.sum_of_squares", &observation.sum_of_squares),
        f64s("normalizer.goal.sum", &goal.sum),
        f64s("normalizer.goal.sum_of_squares", &goal.sum_of_squares),
        f32s("acting.actor", &acting.actor),
        f32s("acting.observation_mean", &acting.observation_mean),
        f32s("acting.observation_std", &acting.observation_std),
        f32s("acting.goal_mean", &acting.goal_mean),
        f32s("acting.goal_std", &acting.goal_std),
    ]
}

fn view_all(tensors: &[OwnedTensor]) -> Vec<(String, TensorView<'_>)> {
    tensors.iter().map(|(name, dtype, bytes)| view(name, *dtype, bytes)).collect()
}

fn view<'a>(name: &str, dtype: Dtype, bytes: &'a [u8]) -> (String, TensorView<'a>) {
    let shape = vec![bytes.len() * 8 / dtype.bitsize()];
    (
        name.to_owned(),
        TensorView::new(dtype, shape, bytes).expect("the shape is counted from the bytes"),
    )
}

/// Makes sure that a file is on the disk and not only on its way there.
fn sync(path: &Path) -> std::io::Result<()> {
    fs::File::open(path)?.sync_all()
}

#[cfg(test)]
mod tests {
    use tandem_core::Task;

    use super::*;
    use crate::config::Recipe;
    use crate::replay::drifting_episode;

    fn small_config() -> RunConfig {
        let mut config = RunConfig::defaults(Recipe::Tandem, Task::Push, 2);
        config.ddpg.n_hidden = 16;
        config.ddpg.n_hidden_layers = 2;
        config.ddpg.batch_size = 8;
        config.rounds.slots = 1;
        config.rounds.updates_per_env_step = 0.02;
        config
    }

    fn train_round(trainer: &mut Trainer) {
        let round = trainer.counters().round;
        let episodes: Vec<_> = (round * 2..round * 2 + 2)
            .map(|number| drifting_episode(trainer.layout, number, 0.002 * number as f32))
            .collect();
        trainer.ingest(&episodes);
        trainer.learn(|_| ()).expect("finite");
    }

    fn resumption(trainer: &Trainer) -> Resumption {
        Resumption { acting: trainer.publish(), wall_s: 12.5 }
    }

    #[test]
    fn a_resumed_run_arrives_at_the_same_bits() {
        let directory = tempfile::tempdir().expect("a directory");
        let mut uninterrupted = Trainer::new(small_config()).expect("valid");
        train_round(&mut uninterrupted);
        save(directory.path(), &uninterrupted, &resumption(&uninterrupted), 2).expect("saves");
        let (mut resumed, loaded) = load_newest(directory.path(), &small_config()).expect("loads");
        assert_eq!(loaded, resumption(&uninterrupted));
        train_round(&mut uninterrupted);
        train_round(&mut resumed);
        assert_eq!(resumed.digest(), uninterrupted.digest());
    }

    #[test]
    fn only_the_newest_checkpoints_stay() {
        let directory = tempfile::tempdir().expect("a directory");
        let mut trainer = Trainer::new(small_config()).expect("valid");
        for _ in 0..3 {
            train_round(&mut trainer);
            save(directory.path(), &trainer, &resumption(&trainer), 2).expect("saves");
        }
        let names: Vec<_> = list(directory.path())
            .iter()
            .filter_map(|path| path.file_stem()?.to_str().map(str::to_owned))
            .collect();
        assert_eq!(names, ["00000002", "00000003"]);
    }

    #[test]
    fn a_damaged_checkpoint_is_refused_by_name_and_the_former_offered() {
        let directory = tempfile::tempdir().expect("a directory");
        let mut trainer = Trainer::new(small_config()).expect("valid");
        for _ in 0..2 {
            train_round(&mut trainer);
            save(directory.path(), &trainer, &resumption(&trainer), 2).expect("saves");
        }
        let newest = list(directory.path()).pop().expect("two");
        let whole = fs::read(&newest).expect("readable");
        let mut flipped = whole.clone();
        *flipped.last_mut().expect("not empty") ^= 1;
        for bytes in [&whole[..whole.len() - 1], &whole[..7], &[], &flipped] {
            fs::write(&newest, bytes).expect("writes");
            let message = load_newest(directory.path(), &small_config())
                .expect_err("must be refused")
                .to_string();
            assert!(message.contains("00000002") && message.contains("00000001"), "{message}");
        }
    }
}
