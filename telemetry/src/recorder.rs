//! Writing of an episode's MCAP log.

use std::path::{Path, PathBuf};

use foxglove::messages::{FrameTransforms, JointStates, Log, SceneUpdate, log::Level};
use tandem_core::layout::GOAL_TOLERANCE_M;
use tandem_core::reward::{distance, sparse_reward};
use tandem_core::scene::Scene;
use tandem_core::{ArmAdvice, Contacts, Layout};

use crate::error::Error;
use crate::log_file::{Channel, LogFile, check_length, log_line, nanoseconds, timestamp};
use crate::messages::{EpisodeMetadata, METADATA_NAME, pb};
use crate::scene::{frame_transforms, joint_states, scene_update};

/// Number of steps after which the log is flushed to disk.
const FLUSH_EVERY_STEPS: u32 = 10;

/// Topics that [`crate::read_episode`] reads.
pub(crate) const TRANSITION_TOPIC: &str = "/transition";
pub(crate) const OUTCOME_TOPIC: &str = "/outcome";

/// One control step, for [`EpisodeRecorder::record_step`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TransitionRecord<'a> {
    /// Number of the step, from 0.
    pub step: u32,
    /// Observation before the step, shape `[n_observation]`.
    pub observation: &'a [f32],
    /// Goal, shape `[n_goal]`.
    pub goal: &'a [f32],
    /// Executed action, in [−1, 1], shape `[n_action]`.
    pub action: &'a [f32],
    /// Joint reward of all arms.
    pub reward: f32,
    /// Reward of each arm, shape `[n_arms]`.
    pub rewards_per_arm: &'a [f32],
    /// Bit `a` is set if arm `a` executed the teacher's action.
    pub advised_arms: u8,
    /// Contacts during the step.
    pub contacts: Contacts,
    /// Advice of the teacher in arm order; empty if it was not asked.
    pub advice: &'a [ArmAdvice],
}

/// Writes one episode to one MCAP file.
///
/// The file is named `NAME.mcap.part` until [`finish`](Self::finish) renames it, so a file without that suffix is
/// always complete. Message times are simulated time since the start of the episode.
pub struct EpisodeRecorder {
    layout: Layout,
    file: LogFile,
    channels: Channels,
    goal: Vec<f32>,
    stats: pb::Stats,
    time_ns: u64,
}

impl EpisodeRecorder {
    /// Creates the log `path` of the episode with this `metadata`. An incomplete log of that name is overwritten.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn create(path: &Path, metadata: &EpisodeMetadata) -> Result<Self, Error> {
        let mut file = LogFile::create(path)?;
        let channels = Channels::start(&mut file, metadata).map_err(file.write_error())?;
        Ok(Self {
            layout: metadata.layout,
            file,
            channels,
            goal: Vec::new(),
            stats: pb::Stats::default(),
            time_ns: 0,
        })
    }

    /// Logs one control step and the scene before it.
    ///
    /// # Errors
    /// If a vector does not fit the layout, or the file cannot be written.
    pub fn record_step(
        &mut self,
        scene: &Scene,
        transition: &TransitionRecord<'_>,
    ) -> Result<(), Error> {
        self.check_lengths(transition)?;
        self.time_ns = nanoseconds(scene.time_s)?;
        self.goal = transition.goal.to_vec();
        self.update_stats(scene, transition);
        let caption = step_caption(&self.stats, transition);
        self.write_step(scene, &caption, transition).map_err(self.file.write_error())
    }

    /// Logs the scene and the observation (shape `[n_observation]`) after the last step, and the outcome.
    ///
    /// # Errors
    /// If the observation does not fit the layout, or the file cannot be written.
    pub fn record_outcome(&mut self, scene: &Scene, observation: &[f32]) -> Result<(), Error> {
        check_length("observation", observation.len(), self.layout.n_observation())?;
        self.time_ns = nanoseconds(scene.time_s)?;
        self.stats.goal_distance_m = goal_distances_m(scene);
        let outcome = self.outcome(observation);
        let result = if outcome.success { "success" } else { "failure" };
        let caption = format!("{result}\nreturn {:.0}", self.stats.episode_return);
        self.write_outcome(scene, &caption, &outcome).map_err(self.file.write_error())
    }

    /// Adds a line to the log channel, at the time of the latest step.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn log(&mut self, message: &str) -> Result<(), Error> {
        let line = log_line(self.time_ns, Level::Info, message);
        let (file, now) = (&mut self.file, self.time_ns);
        self.channels.log.write(file, now, &line).map_err(self.file.write_error())
    }

    /// Completes the file, gives it its final name and returns its path.
    ///
    /// # Errors
    /// If the file cannot be written or renamed.
    pub fn finish(self) -> Result<PathBuf, Error> {
        self.file.finish()
    }

    fn check_lengths(&self, transition: &TransitionRecord<'_>) -> Result<(), Error> {
        check_length("observation", transition.observation.len(), self.layout.n_observation())?;
        check_length("goal", transition.goal.len(), self.layout.n_goal())?;
        check_length("action", transition.action.len(), self.layout.n_action())?;
        check_length("rewards_per_arm", transition.rewards_per_arm.len(), self.layout.n_arms)?;
        if !transition.advice.is_empty() {
            check_length("advice", transition.advice.len(), self.layout.n_arms)?;
        }
        Ok(())
    }

    fn update_stats(&mut self, scene: &Scene, transition: &TransitionRecord<'_>) {
        self.stats.step = transition.step;
        self.stats.episode_return += f64::from(transition.reward);
        self.stats.goal_distance_m = goal_distances_m(scene);
        self.stats.advised_steps += u32::from(transition.advised_arms != 0);
        self.stats.contact_steps += u32::from(transition.contacts.any());
    }

    fn outcome(&self, observation: &[f32]) -> pb::Outcome {
        let at_goal = |arm| match self.goal.get(self.layout.goal_of(arm)) {
            Some(goal) => {
                sparse_reward(&observation[self.layout.achieved_goal_of(arm)], goal) > -0.5
            }
            None => false,
        };
        let success_per_arm: Vec<bool> = self.layout.arms().map(at_goal).collect();
        pb::Outcome {
            observation: observation.to_vec(),
            success: success_per_arm.iter().all(|success| *success),
            success_per_arm,
            stats: Some(self.stats.clone()),
        }
    }

    fn write_step(
        &mut self,
        scene: &Scene,
        caption: &str,
        step: &TransitionRecord<'_>,
    ) -> mcap::McapResult<()> {
        self.write_scene(scene, caption)?;
        self.channels.transition.write(&mut self.file, self.time_ns, &transition_message(step))?;
        self.channels.stats.write(&mut self.file, self.time_ns, &self.stats)?;
        if (step.step + 1).is_multiple_of(FLUSH_EVERY_STEPS) {
            self.file.flush()?;
        }
        Ok(())
    }

    fn write_outcome(
        &mut self,
        scene: &Scene,
        caption: &str,
        outcome: &pb::Outcome,
    ) -> mcap::McapResult<()> {
        self.write_scene(scene, caption)?;
        self.channels.outcome.write(&mut self.file, self.time_ns, outcome)?;
        self.file.flush()
    }

    fn write_scene(&mut self, scene: &Scene, caption: &str) -> mcap::McapResult<()> {
        let (file, now) = (&mut self.file, self.time_ns);
        let stamp = timestamp(now);
        self.channels.scene.write(file, now, &scene_update(scene, stamp, caption))?;
        self.channels.tf.write(file, now, &frame_transforms(scene, stamp))?;
        self.channels.joint_states.write(file, now, &joint_states(scene, stamp))
    }
}

struct Channels {
    scene: Channel<SceneUpdate>,
    tf: Channel<FrameTransforms>,
    joint_states: Channel<JointStates>,
    log: Channel<Log>,
    transition: Channel<pb::Transition>,
    stats: Channel<pb::Stats>,
    outcome: Channel<pb::Outcome>,
}

impl Channels {
    /// Writes metadata and channels to the start of `file` and flushes it.
    fn start(file: &mut LogFile, metadata: &EpisodeMetadata) -> mcap::McapResult<Self> {
        file.write_metadata(METADATA_NAME, metadata.to_map())?;
        let channels = Self {
            scene: Channel::open(file, "/scene")?,
            tf: Channel::open(file, "/tf")?,
            joint_states: Channel::open(file, "/joint_states")?,
            log: Channel::open(file, "/log")?,
            transition: Channel::open(file, TRANSITION_TOPIC)?,
            stats: Channel::open(file, "/stats")?,
            outcome: Channel::open(file, OUTCOME_TOPIC)?,
        };
        file.flush()?;
        Ok(channels)
    }
}

fn transition_message(step: &TransitionRecord<'_>) -> pb::Transition {
    pb::Transition {
        step: step.step,
        observation: step.observation.to_vec(),
        goal: step.goal.to_vec(),
        action: step.action.to_vec(),
        reward: step.reward,
        rewards_per_arm: step.rewards_per_arm.to_vec(),
        advised_arms: u32::from(step.advised_arms),
        contacts: u32::from(step.contacts.bits()),
        advice: step.advice.iter().map(pb::ArmAdvice::from).collect(),
    }
}

fn step_caption(stats: &pb::Stats, step: &TransitionRecord<'_>) -> String {
    let n_reached =
        stats.goal_distance_m.iter().filter(|distance_m| **distance_m <= GOAL_TOLERANCE_M).count();
    format!(
        "step {}   reward {:.0}\nat goal {n_reached} of {}\nadvised steps {}   contact steps {}",
        stats.step,
        step.reward,
        stats.goal_distance_m.len(),
        stats.advised_steps,
        stats.contact_steps,
    )
}

fn goal_distances_m(scene: &Scene) -> Vec<f32> {
    scene
        .objects
        .iter()
        .zip(&scene.goals)
        .map(|(object, goal)| distance(&object.centre, goal))
        .collect()
}
