//! The thread that writes the logs of episodes, so that a slow or full disk delays no rollout.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};

use tandem_core::Episode;
use tandem_telemetry::events::EpisodeRecorded;
use tandem_telemetry::{EpisodeMetadata, LogBudget};
use tokio_util::task::task_tracker::TaskTrackerToken;

use crate::config::{RecordedEpisodes, RecordingConfig};
use crate::record::{RecordError, log_name, record_episode, record_traced};
use crate::trace::Trace;

/// Episodes that wait for the thread, a few hundred kB each. Beyond them, training episodes are left out.
const QUEUE_CAPACITY: usize = 64;
/// Episodes that are left out after a log could not be written, before the next attempt.
const PAUSE_EPISODES: u32 = 100;

/// An episode to record.
pub(crate) struct Recording {
    pub(crate) metadata: EpisodeMetadata,
    pub(crate) episode: Episode,
    /// The trace of the episode; without one, the episode is simulated again.
    pub(crate) trace: Option<Trace>,
}

/// The sender of episodes to the thread, which ends when all senders are dropped.
#[derive(Debug, Clone)]
pub(crate) struct Recorder {
    queue: SyncSender<Recording>,
    episodes: RecordedEpisodes,
    /// The log has a warning that episodes are left out.
    left_out_logged: Arc<AtomicBool>,
}

impl Recorder {
    /// Starts the thread. It holds `tracked` until it has ended.
    pub(crate) fn start(
        config: RecordingConfig,
        tracked: TaskTrackerToken,
    ) -> std::io::Result<Self> {
        let (queue, recordings) = sync_channel(QUEUE_CAPACITY);
        let writer = LogWriter {
            budget: LogBudget::new(config.directory.clone(), config.budget_bytes),
            directory: config.directory,
            n_to_skip: 0,
            is_paused: false,
        };
        std::thread::Builder::new().name("recorder".to_owned()).spawn(move || {
            let _tracked = tracked;
            writer.run(&recordings);
        })?;
        Ok(Self { queue, episodes: config.episodes, left_out_logged: Arc::default() })
    }

    /// Returns true if training episodes are recorded.
    pub(crate) fn records_training(&self) -> bool {
        self.episodes == RecordedEpisodes::All
    }

    /// Queues an evaluation episode, after waiting for room.
    pub(crate) fn record(&self, recording: Recording) {
        // Fails only if the thread has panicked, which is logged there.
        drop(self.queue.send(recording));
    }

    /// Queues a training episode, or leaves it out if the thread has fallen behind.
    pub(crate) fn try_record(&self, recording: Recording) {
        if let Err(TrySendError::Full(left_out)) = self.queue.try_send(recording)
            && !self.left_out_logged.swap(true, Ordering::Relaxed)
        {
            let episode = left_out.episode.number;
            tracing::warn!(episode, "recording falls behind: episodes are left out");
        }
    }
}

/// The state of the thread.
struct LogWriter {
    directory: PathBuf,
    budget: LogBudget,
    /// Number of episodes to leave out before the next attempt.
    n_to_skip: u32,
    /// The latest log could not be written.
    is_paused: bool,
}

impl LogWriter {
    fn run(mut self, recordings: &Receiver<Recording>) {
        for recording in recordings {
            match self.n_to_skip.checked_sub(1) {
                Some(left) => self.n_to_skip = left,
                None => self.record(&recording),
            }
        }
    }

    /// Writes an episode's log. Failures are only logged: the episode itself was delivered.
    fn record(&mut self, recording: &Recording) {
        let number = recording.episode.number;
        let path = self.directory.join(log_name(&recording.episode));
        match self.write(recording, &path) {
            Ok(()) => {
                EpisodeRecorded { episode: number, path: &path }.emit();
                if std::mem::take(&mut self.is_paused) {
                    tracing::info!(episode = number, "recording resumed");
                }
            }
            Err(RecordError::Log(tandem_telemetry::Error::LogInUse { path })) => {
                tracing::debug!(episode = number, ?path, "another worker records the episode");
            }
            Err(error @ RecordError::Log(_)) => {
                self.n_to_skip = PAUSE_EPISODES;
                if !std::mem::replace(&mut self.is_paused, true) {
                    let error: &dyn std::error::Error = &error;
                    tracing::warn!(episode = number, ?path, error, "recording paused");
                }
            }
            Err(error) => {
                let error: &dyn std::error::Error = &error;
                tracing::warn!(episode = number, ?path, error, "episode not recorded");
            }
        }
    }

    fn write(&mut self, recording: &Recording, path: &Path) -> Result<(), RecordError> {
        let Recording { metadata, episode, trace } = recording;
        // The directory may have been deleted to make room. If it cannot be created, the log cannot either.
        drop(std::fs::create_dir_all(&self.directory));
        let written = match trace {
            Some(trace) => record_traced(metadata, episode, trace, path),
            None => record_episode(metadata, episode, path),
        };
        let is_of_another =
            matches!(written, Err(RecordError::Log(tandem_telemetry::Error::LogInUse { .. })));
        if written.is_err() && !is_of_another {
            // An incomplete log would occupy what may be the last space.
            drop(std::fs::remove_file(format!("{}.part", path.display())));
        }
        let written = written?;
        let n_bytes = std::fs::metadata(&written).map_or(0, |metadata| metadata.len());
        self.budget.add(&written, n_bytes)?;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use tandem_core::work::EpisodeOrder;
    use tandem_sim::{Env, WorldConfig};
    use tandem_telemetry::read_episode;

    use super::*;
    use crate::fakes::{FakeActor, FakeTeacher, LAYOUT, slot, terms};
    use crate::ports::{Act, Simulator};
    use crate::record::metadata_of;
    use crate::replay::replay_log;
    use crate::rollout::{Tracing, play_slot, play_traced_slot};

    fn simulator() -> Simulator {
        let config = WorldConfig::from(terms().world);
        Simulator::new(Env::new(LAYOUT, &config).expect("in range"))
    }

    /// Returns traced training episodes with these numbers, whose first arm the teacher overrides on even steps.
    fn traced(numbers: &[u64]) -> Vec<Recording> {
        let (order, terms) = (slot(numbers, true), terms());
        let mut teacher = FakeTeacher::new(|_, step, arm| arm == 0 && step.is_multiple_of(2));
        let played = play_traced_slot(
            &mut simulator(),
            &order,
            &terms,
            &mut FakeActor::Seeker,
            &mut teacher,
            Tracing::On,
        );
        let played = played.expect("no step fails").into_iter().zip(&order.episodes);
        let recording = |((episode, trace), order): ((Episode, _), &EpisodeOrder)| Recording {
            metadata: metadata_of(*order, &episode, &terms, "5f3a".to_owned()),
            episode,
            trace,
        };
        played.map(recording).collect()
    }

    fn writer(directory: &Path) -> LogWriter {
        LogWriter {
            directory: directory.to_owned(),
            budget: LogBudget::new(directory.to_owned(), u64::MAX),
            n_to_skip: 0,
            is_paused: false,
        }
    }

    #[test]
    fn a_training_log_shows_who_acts_and_simulates_to_the_same_bits() {
        let directory = tempfile::tempdir().expect("a directory");
        let recording = traced(&[3]).remove(0);
        writer(directory.path()).record(&recording);
        let log = read_episode(&directory.path().join("train-000004-000003.mcap")).expect("whole");
        for (step_idx, step) in log.transitions.iter().enumerate() {
            let overridden: Vec<bool> = step.advice.iter().map(|arm| arm.overridden).collect();
            assert_eq!(overridden, [step_idx % 2 == 0, false], "step {step_idx}");
            assert_eq!(step.budget_left, None, "unknown to this teacher");
        }
        replay_log(&log).expect("the same bits");
    }

    /// Asks the teacher in every second step.
    struct AsksSometimes {
        n_steps: usize,
    }

    impl Act for AsksSometimes {
        fn act(&mut self, observations: &[f32], goals: &[f32], actions: &mut [f32]) {
            FakeActor::Seeker.act(observations, goals, actions);
        }

        fn asks(&mut self, _observation: &[f32], _goal: &[f32], _action: &[f32]) -> bool {
            self.n_steps += 1;
            self.n_steps.is_multiple_of(2)
        }
    }

    #[test]
    fn advice_is_traced_on_the_step_on_which_the_student_asked() {
        let (order, terms) = (slot(&[3], true), terms());
        let mut teacher = FakeTeacher::new(|_, _, arm| arm == 0);
        let actor = &mut AsksSometimes { n_steps: 0 };
        let (env, tracing) = (&mut simulator(), Tracing::On);
        let played = play_traced_slot(env, &order, &terms, actor, &mut teacher, tracing);
        let (episode, trace) = played.expect("no step fails").remove(0);
        let trace = trace.expect("traced");
        assert_eq!(trace.advice.len(), episode.n_steps());
        for (step_idx, advice) in trace.advice.iter().enumerate() {
            assert_eq!(advice.arms.len(), if step_idx % 2 == 1 { 2 } else { 0 }, "{step_idx}");
            assert_eq!(episode.advised_arms[step_idx] != 0, !advice.arms.is_empty());
        }
    }

    #[test]
    fn tracing_changes_no_episode() {
        let (order, terms) = (slot(&[3, 4], true), terms());
        let overrides = |_, step: u32, arm| arm == 0 && step.is_multiple_of(2);
        let untraced = play_slot(
            &mut simulator(),
            &order,
            &terms,
            &mut FakeActor::Seeker,
            &mut FakeTeacher::new(overrides),
        );
        let traced: Vec<Episode> =
            traced(&[3, 4]).into_iter().map(|recording| recording.episode).collect();
        assert_eq!(untraced.expect("no step fails"), traced);
    }

    #[test]
    fn training_episodes_beyond_the_queue_are_left_out_and_evaluations_wait() {
        let (queue, recordings) = sync_channel(1);
        let left_out_logged = Arc::<AtomicBool>::default();
        let recorder = Recorder {
            queue,
            episodes: RecordedEpisodes::All,
            left_out_logged: left_out_logged.clone(),
        };
        let mut played = traced(&[3, 4, 5]).into_iter();
        let mut next = || played.next().expect("three episodes");
        recorder.try_record(next());
        assert!(!left_out_logged.load(Ordering::Relaxed));
        recorder.try_record(next());
        assert!(left_out_logged.load(Ordering::Relaxed), "the second is left out");
        let evaluation = next();
        let waits = std::thread::spawn(move || recorder.record(evaluation));
        std::thread::sleep(std::time::Duration::from_millis(50));
        assert!(!waits.is_finished(), "it waits for room");
        let numbers: Vec<u64> =
            recordings.iter().map(|recording| recording.episode.number).collect();
        waits.join().expect("no panic");
        assert_eq!(numbers, [3, 5]);
    }

    #[test]
    fn a_log_that_cannot_be_written_pauses_recording() {
        let directory = tempfile::tempdir().expect("a directory");
        let logs = directory.path().join("mcap");
        std::fs::write(&logs, "a file in the way").expect("writable");
        let (mut writer, recording) = (writer(&logs), traced(&[3]).remove(0));
        writer.record(&recording);
        assert!(writer.is_paused && writer.n_to_skip == PAUSE_EPISODES);
        std::fs::remove_file(&logs).expect("there is one");
        let (queue, recordings) = sync_channel(usize::try_from(PAUSE_EPISODES).expect("few") + 1);
        for _ in 0..=PAUSE_EPISODES {
            let Recording { metadata, episode, .. } = &recording;
            let (metadata, episode) = (metadata.clone(), episode.clone());
            let trace = Some(Trace::default());
            queue.send(Recording { metadata, episode, trace }).expect("room");
        }
        drop(queue);
        writer.run(&recordings);
        assert_eq!(std::fs::read_dir(&logs).expect("readable").count(), 1, "recorded again");
    }
}
