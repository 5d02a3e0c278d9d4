//! The files that show episodes of an evaluation: logs and a film.

use std::path::{Path, PathBuf};

use rayon::iter::{IntoParallelRefIterator as _, ParallelIterator as _};
use tandem_core::work::{EpisodeExploration, EpisodeOrder, RunTerms};
use tandem_core::{AdviceTerms, Episode, Exploration, Layout, WorldSettings};
use tandem_picture::FilmEpisode;
use tandem_worker::record::{RecordError, log_name, metadata_of, record_episode};

use crate::cli::{EvalArgs, OutcomeName};
use crate::evaluation::EvaluatedPolicy;
use crate::exit::{Exit, Failed, OrExit as _};
use crate::film::{self, PlannedFilm};

/// Writes logs while episodes are played, and keeps the episodes of the film.
pub(super) struct EpisodeFiles<'a> {
    args: &'a EvalArgs,
    subject: &'a EvaluatedPolicy,
    terms: RunTerms,
    logs: Logs,
    filmed: Vec<Episode>,
    /// The result of writing logs so far. After an error, no more are written.
    written: Result<(), Failed>,
}

/// The logs of all episodes, if they are written. Temporary ones are removed when this value is dropped.
pub(super) struct Logs {
    directory: Option<PathBuf>,
    is_temporary: bool,
    paths: Vec<PathBuf>,
}

impl Logs {
    /// Returns the logs in the order of their episodes.
    pub(super) fn paths(&self) -> &[PathBuf] {
        &self.paths
    }
}

impl Drop for Logs {
    fn drop(&mut self) {
        if let Some(directory) = self.directory.as_ref().filter(|_| self.is_temporary) {
            drop(std::fs::remove_dir_all(directory));
        }
    }
}

impl<'a> EpisodeFiles<'a> {
    /// Plans the files that `args` asks for.
    pub(super) fn new(args: &'a EvalArgs, subject: &'a EvaluatedPolicy) -> Self {
        // Viewers see logs: without a directory for them, they are temporary.
        let is_temporary = args.record_dir.is_none() && args.live.live.is_some();
        let temporary = || std::env::temp_dir().join(format!("tandem-live-{}", std::process::id()));
        let directory = args.record_dir.clone().or_else(|| is_temporary.then(temporary));
        Self {
            args,
            subject,
            terms: terms(subject),
            logs: Logs { directory, is_temporary, paths: Vec::new() },
            filmed: Vec::new(),
            written: Ok(()),
        }
    }

    /// Writes the logs of the next episodes, and keeps those of the film.
    pub(super) fn take(&mut self, episodes: &[Episode]) {
        if self.written.is_ok() {
            self.written = self.record(episodes);
        }
        if self.args.film.film.is_some() {
            let n_filmed = usize::try_from(self.args.film_episodes).unwrap_or(usize::MAX);
            let n_missing = n_filmed.saturating_sub(self.filmed.len());
            let shown = episodes.iter().filter(|episode| is_shown(self.args, episode));
            self.filmed.extend(shown.take(n_missing).cloned());
        }
    }

    /// Writes the film, if there is one, and returns the logs.
    pub(super) fn finish(self, film: Option<PlannedFilm<'_>>) -> Result<Logs, Failed> {
        self.written?;
        let Some(film) = film else { return Ok(self.logs) };
        if self.filmed.is_empty() {
            return Err(Failed::usage(format!(
                "--film-outcome: none of {} episodes has this outcome; try more --episodes or another --seed",
                self.args.episodes
            )));
        }
        let (layout, seed) = (self.subject.layout(), self.args.seed);
        film.write(&films(layout, seed, &self.filmed)?)?;
        Ok(self.logs)
    }

    fn record(&mut self, episodes: &[Episode]) -> Result<(), Failed> {
        let first = episodes.iter().find(|episode| episode.number == 0);
        if let (Some(path), Some(first)) = (&self.args.record, first) {
            self.record_one(first, path)?;
        }
        let Some(directory) = &self.logs.directory else { return Ok(()) };
        std::fs::create_dir_all(directory)
            .or_cannot_write(|| format!("cannot create {}", directory.display()))?;
        episodes
            .par_iter()
            .try_for_each(|episode| self.record_one(episode, &directory.join(log_name(episode))))?;
        let paths = episodes.iter().map(|episode| directory.join(log_name(episode)));
        self.logs.paths.extend(paths);
        Ok(())
    }

    /// Writes the log of one episode.
    fn record_one(&self, episode: &Episode, path: &Path) -> Result<(), Failed> {
        let order = EpisodeOrder {
            number: episode.number,
            seed: self.args.seed,
            advised: false,
            exploration: EpisodeExploration::Noise,
            record: true,
            advised_steps: None,
        };
        let digest = self.subject.policy().digest();
        let metadata = metadata_of(order, episode, &self.terms, digest);
        match record_episode(&metadata, episode, path) {
            Ok(_) => Ok(()),
            Err(error @ RecordError::Log(_)) => Err(error).or_cannot_write(String::new),
            Err(error) => Err(Failed::new(Exit::Bug, error)),
        }
    }
}

/// Returns true if the film may show this episode.
fn is_shown(args: &EvalArgs, episode: &Episode) -> bool {
    match args.film_outcome {
        None => true,
        Some(OutcomeName::Success) => episode.succeeded(),
        Some(OutcomeName::Failure) => !episode.succeeded(),
    }
}

fn films(layout: Layout, seed: u64, episodes: &[Episode]) -> Result<Vec<FilmEpisode>, Failed> {
    episodes.iter().map(|episode| film::of_evaluation(layout, seed, episode)).collect()
}

/// Returns the terms of an evaluation, for the metadata of its logs.
fn terms(subject: &EvaluatedPolicy) -> RunTerms {
    RunTerms {
        run: String::new(),
        task: subject.layout().into(),
        account: None,
        advice: AdviceTerms::default(),
        exploration: Exploration::NONE,
        world: WorldSettings::default(),
        symmetrized_evaluation: false,
    }
}
