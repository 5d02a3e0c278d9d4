//! The environments of one stream.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use rayon::iter::ParallelIterator as _;
use rayon::iter::{IndexedParallelIterator as _, IntoParallelRefMutIterator as _};
use rayon::slice::{ParallelSlice as _, ParallelSliceMut as _};
use tandem_core::rng::{Stream, episode_rng};
use tandem_core::work::EpisodeStart;
use tandem_core::{Contacts, Layout, TaskSpec};
use tandem_proto::environment::{PlayCommand, encode_reset_reply, encode_step_reply};
use tandem_proto::pb;
use tandem_sim::{Env, SimError, WorldConfig};

/// Environments of a layout, built once for each number of physics steps and then cloned.
#[derive(Clone)]
pub(crate) struct Prototypes {
    layout: Layout,
    task: TaskSpec,
    by_substeps: Arc<Mutex<BTreeMap<u32, Env>>>,
}

impl Prototypes {
    /// Creates an empty collection. Fails if the simulator does not support the layout.
    pub(crate) fn new(layout: Layout) -> Result<Self, SimError> {
        let prototypes = Self { layout, task: layout.into(), by_substeps: Arc::default() };
        prototypes.get(WorldConfig::default().substeps)?;
        Ok(prototypes)
    }

    pub(crate) const fn task(&self) -> &TaskSpec {
        &self.task
    }

    fn get(&self, substeps: u32) -> Result<Env, SimError> {
        let known = self.by_substeps().get(&substeps).cloned();
        if let Some(env) = known {
            return Ok(env);
        }
        // Other streams need not wait until it is built.
        let env = Env::new(self.layout, &WorldConfig { substeps, ..WorldConfig::default() })?;
        self.by_substeps().insert(substeps, env.clone());
        Ok(env)
    }

    fn by_substeps(&self) -> MutexGuard<'_, BTreeMap<u32, Env>> {
        self.by_substeps.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// A failed request of a stream.
#[derive(Debug, PartialEq, thiserror::Error)]
pub(crate) enum SessionError {
    /// A reset asks for a world that cannot be built.
    #[error("reset: {0}")]
    Reset(SimError),
    /// A step failed.
    #[error("environment {environment}: {source}")]
    Step { environment: usize, source: SimError },
}

/// The environments of one stream, in lock step.
pub(crate) struct Session {
    prototypes: Prototypes,
    /// Empty before the first reset.
    environments: Vec<Environment>,
}

struct Environment {
    substeps: u32,
    env: Env,
}

impl Session {
    pub(crate) const fn new(prototypes: Prototypes) -> Self {
        Self { prototypes, environments: Vec::new() }
    }

    pub(crate) const fn task(&self) -> &TaskSpec {
        &self.prototypes.task
    }

    /// Returns the number of environments; `None` before the first reset.
    pub(crate) fn n(&self) -> Option<usize> {
        (!self.environments.is_empty()).then_some(self.environments.len())
    }

    /// Executes a command that was decoded for this number of environments.
    pub(crate) fn execute(
        &mut self,
        command: PlayCommand,
    ) -> Result<pb::PlayResponse, SessionError> {
        match command {
            PlayCommand::Reset(resets) => self.reset(&resets).map_err(SessionError::Reset),
            PlayCommand::Step(actions) => self.step(&actions),
        }
    }

    fn reset(&mut self, resets: &[(usize, EpisodeStart)]) -> Result<pb::PlayResponse, SimError> {
        let layout = self.prototypes.layout;
        let mut observations = vec![0.0; resets.len() * layout.n_observation()];
        let mut goals = Vec::with_capacity(resets.len() * layout.n_goal());
        let rows = observations.chunks_exact_mut(layout.n_observation());
        for ((idx, start), observation) in resets.iter().zip(rows) {
            let env = self.environment(*idx, start.world.substeps)?;
            let mut rng = episode_rng(start.seed, start.number, Stream::Reset);
            env.reset(&mut rng, start.world.for_kind(start.kind));
            env.observe(observation);
            goals.extend_from_slice(env.goal());
        }
        Ok(encode_reset_reply(&observations, &goals))
    }

    /// Returns environment `idx`, creating it if it is missing or has other `substeps`.
    fn environment(&mut self, idx: usize, substeps: u32) -> Result<&mut Env, SimError> {
        let fits = self.environments.get(idx).is_some_and(|known| known.substeps == substeps);
        if !fits {
            let environment = Environment { substeps, env: self.prototypes.get(substeps)? };
            match self.environments.get_mut(idx) {
                Some(known) => *known = environment,
                None => self.environments.push(environment),
            }
        }
        Ok(&mut self.environments[idx].env)
    }

    /// Steps all environments, in parallel: they are independent of each other.
    fn step(&mut self, actions: &[f32]) -> Result<pb::PlayResponse, SessionError> {
        let layout = self.prototypes.layout;
        let mut observations = vec![0.0; self.environments.len() * layout.n_observation()];
        let stepped: Vec<Result<Contacts, SimError>> = self
            .environments
            .par_iter_mut()
            .zip(actions.par_chunks_exact(layout.n_action()))
            .zip(observations.par_chunks_exact_mut(layout.n_observation()))
            .map(|((environment, action), observation)| {
                let contacts = environment.env.step(action)?;
                environment.env.observe(observation);
                Ok(contacts)
            })
            .collect();
        let mut contacts = Vec::with_capacity(stepped.len());
        for (environment, outcome) in stepped.into_iter().enumerate() {
            let failed = |source| SessionError::Step { environment, source };
            contacts.push(outcome.map_err(failed)?);
        }
        Ok(encode_step_reply(&observations, &contacts))
    }
}
