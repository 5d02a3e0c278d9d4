//! Writing of an episode's MCAP log.

use std::path::{Path, PathBuf};

use foxglove::messages::{FrameTransforms, JointStates, Log, SceneUpdate, log::Level};
use tandem_core::reward::distance;
use tandem_core::scene::Scene;
use tandem_core::{ArmAdvice, ArmIndex, Contacts, TaskSpec};

use crate::error::Error;
use crate::log_file::{Channel, LogFile, check_length, log_line, nanoseconds, timestamp};
use crate::messages::{EpisodeMetadata, METADATA_NAME, pb};
use crate::scene::{GoalMarkers, frame_transforms, joint_states, scene_update};

/// Number of steps after which the log is flushed to disk.
const FLUSH_EVERY_STEPS: u32 = 10;
/// Time of a control step in the log of a task without a simulator, whose description has no duration, seconds.
const NOMINAL_STEP_S: f64 = 0.1;

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
    /// Units of the advice budget left when the teacher answered; `None` if it was not asked.
    pub budget_left: Option<u64>,
}

/// For how many consecutive steps, up to the latest one, the arms succeed.
struct Successes {
    /// Each arm by itself.
    per_arm: Vec<usize>,
    /// All arms together.
    all: usize,
}

impl Successes {
    fn count(&mut self, task: &TaskSpec, observation: &[f32], goal: &[f32]) {
        let next = |n_steps: usize, succeeds: bool| if succeeds { n_steps + 1 } else { 0 };
        for (n_steps, arm) in self.per_arm.iter_mut().zip(task.arms()) {
            *n_steps = next(*n_steps, task.arm_succeeds(arm, observation, goal));
        }
        self.all = next(self.all, task.is_success(observation, goal));
    }
}

/// Writes one episode to one MCAP file.
///
/// The file is named `NAME.mcap.part` until [`finish`](Self::finish) renames it, so a file without that suffix is
/// always complete. Message times are simulated time since the start of the episode; without a scene, a control step
/// takes a nominal 0.1 s.
///
/// The log of a task that is not built-in has no bodies to draw. Its scene has the achieved and the desired goals
/// instead if these are points: parts of 2 or 3 numbers.
pub struct EpisodeRecorder {
    task: TaskSpec,
    file: LogFile,
    channels: Channels,
    markers: Option<GoalMarkers>,
    goal: Vec<f32>,
    stats: pb::Stats,
    successes: Successes,
    time_ns: u64,
    /// True if the log is flushed while it is written.
    is_flushed: bool,
}

impl EpisodeRecorder {
    /// Creates the log `path` of the episode with this `metadata`. An incomplete log of that name is overwritten.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn create(path: &Path, metadata: &EpisodeMetadata) -> Result<Self, Error> {
        let mut file = LogFile::create(path)?;
        let task = metadata.task.clone();
        let markers = GoalMarkers::of(&task).filter(|_| task.as_built_in().is_none());
        let has_scene = task.as_built_in().is_some() || markers.is_some();
        let channels = Channels::start(&mut file, metadata, has_scene);
        let channels = channels.map_err(file.write_error())?;
        Ok(Self {
            file,
            channels,
            markers,
            goal: Vec::new(),
            stats: pb::Stats::default(),
            successes: Successes { per_arm: vec![0; task.n_arms()], all: 0 },
            task,
            time_ns: 0,
            is_flushed: true,
        })
    }

    /// Writes the steps in one piece at the end, which takes less time and space: for an episode that was played before
    /// it is recorded.
    #[must_use]
    pub fn in_one_piece(self) -> Self {
        Self { is_flushed: false, ..self }
    }

    /// Logs one control step and the scene before it, if there is one.
    ///
    /// # Errors
    /// If a vector does not fit the task, or the file cannot be written.
    pub fn record_step<'a>(
        &mut self,
        scene: impl Into<Option<&'a Scene>>,
        transition: &TransitionRecord<'_>,
    ) -> Result<(), Error> {
        self.check_lengths(transition)?;
        let scene = scene.into();
        self.set_time(scene, transition.step)?;
        transition.goal.clone_into(&mut self.goal);
        self.update_stats(scene, transition);
        self.successes.count(&self.task, transition.observation, &self.goal);
        let caption = self.step_caption(transition);
        let state = State { scene, observation: transition.observation, caption };
        self.write_step(&state, transition).map_err(self.file.write_error())
    }

    /// Logs the scene, if there is one, and the observation (shape `[n_observation]`) after the last step, and the
    /// outcome.
    ///
    /// # Errors
    /// If the observation does not fit the task, or the file cannot be written.
    pub fn record_outcome<'a>(
        &mut self,
        scene: impl Into<Option<&'a Scene>>,
        observation: &[f32],
    ) -> Result<(), Error> {
        check_length("observation", observation.len(), self.task.n_observation())?;
        let scene = scene.into();
        self.set_time(scene, self.stats.step + 1)?;
        self.set_distances(scene, observation);
        if !self.goal.is_empty() {
            self.successes.count(&self.task, observation, &self.goal);
        }
        let outcome = self.outcome(observation);
        let result = if outcome.success { "success" } else { "failure" };
        let caption = format!("{result}\nreturn {:.0}", self.stats.episode_return);
        let state = State { scene, observation, caption };
        self.write_outcome(&state, &outcome).map_err(self.file.write_error())
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
        check_length("observation", transition.observation.len(), self.task.n_observation())?;
        check_length("goal", transition.goal.len(), self.task.n_goal())?;
        check_length("action", transition.action.len(), self.task.n_action())?;
        check_length("rewards_per_arm", transition.rewards_per_arm.len(), self.task.n_arms())?;
        if !transition.advice.is_empty() {
            check_length("advice", transition.advice.len(), self.task.n_arms())?;
        }
        Ok(())
    }

    /// Sets the time of the following messages: that of the scene, or else of control step `step`.
    fn set_time(&mut self, scene: Option<&Scene>, step: u32) -> Result<(), Error> {
        let nominal_s = f64::from(step) * NOMINAL_STEP_S;
        self.time_ns = nanoseconds(scene.map_or(nominal_s, |scene| scene.time_s))?;
        Ok(())
    }

    fn update_stats(&mut self, scene: Option<&Scene>, transition: &TransitionRecord<'_>) {
        self.stats.step = transition.step;
        self.stats.acting = acting(&self.task, transition.advised_arms);
        self.stats.episode_return += f64::from(transition.reward);
        self.set_distances(scene, transition.observation);
        self.stats.advised_steps += u32::from(transition.advised_arms != 0);
        self.stats.contact_steps += u32::from(transition.contacts.any());
    }

    /// Sets the distances from the goals; there is no goal before the first step.
    fn set_distances(&mut self, scene: Option<&Scene>, observation: &[f32]) {
        if self.goal.is_empty() {
            return;
        }
        self.stats.goal_distance = self.task.goal_distances(observation, &self.goal);
        self.stats.goal_distance_m = scene.map(goal_distances_m).unwrap_or_default();
    }

    /// Returns for each arm whether it succeeds now; there is no goal before the first step.
    fn success_per_arm(&self, observation: &[f32]) -> Vec<bool> {
        let at_goal =
            |arm| !self.goal.is_empty() && self.task.arm_succeeds(arm, observation, &self.goal);
        self.task.arms().map(at_goal).collect()
    }

    fn step_caption(&self, step: &TransitionRecord<'_>) -> String {
        let at_goal = self.success_per_arm(step.observation);
        let n_reached = at_goal.iter().filter(|reached| **reached).count();
        let mut caption = format!(
            "step {}   reward {:.0}\nat goal {n_reached} of {}\nadvised steps {}",
            self.stats.step,
            step.reward,
            at_goal.len(),
            self.stats.advised_steps,
        );
        if self.task.reports_contacts() {
            caption.push_str(&format!("   contact steps {}", self.stats.contact_steps));
        }
        caption
    }

    /// Returns the outcome as an evaluation counts it.
    fn outcome(&self, observation: &[f32]) -> pb::Outcome {
        let lasts = |n_steps: &usize| *n_steps >= self.task.success_steps();
        pb::Outcome {
            observation: observation.to_vec(),
            success: lasts(&self.successes.all),
            success_per_arm: self.successes.per_arm.iter().map(lasts).collect(),
            stats: Some(self.stats.clone()),
        }
    }

    fn write_step(
        &mut self,
        state: &State<'_>,
        step: &TransitionRecord<'_>,
    ) -> mcap::McapResult<()> {
        self.write_scene(state)?;
        let message = transition_message(&self.task, step);
        self.channels.transition.write(&mut self.file, self.time_ns, &message)?;
        self.channels.stats.write(&mut self.file, self.time_ns, &self.stats)?;
        if self.is_flushed && (step.step + 1).is_multiple_of(FLUSH_EVERY_STEPS) {
            self.file.flush()?;
        }
        Ok(())
    }

    fn write_outcome(&mut self, state: &State<'_>, outcome: &pb::Outcome) -> mcap::McapResult<()> {
        self.write_scene(state)?;
        self.channels.outcome.write(&mut self.file, self.time_ns, outcome)?;
        if self.is_flushed { self.file.flush() } else { Ok(()) }
    }

    fn write_scene(&mut self, state: &State<'_>) -> mcap::McapResult<()> {
        let (file, now) = (&mut self.file, self.time_ns);
        let stamp = timestamp(now);
        let update = match (state.scene, &self.markers) {
            (Some(scene), _) => Some(scene_update(scene, stamp, &state.caption)),
            (None, Some(markers)) => {
                Some(markers.scene_update(state.observation, &self.goal, stamp, &state.caption))
            }
            (None, None) => None,
        };
        if let Some((update, channel)) = update.zip(self.channels.scene.as_mut()) {
            channel.write(file, now, &update)?;
        }
        if let Some((scene, bodies)) = state.scene.zip(self.channels.bodies.as_mut()) {
            bodies.tf.write(file, now, &frame_transforms(scene, stamp))?;
            bodies.joint_states.write(file, now, &joint_states(scene, stamp))?;
        }
        Ok(())
    }
}

/// The world at one time.
struct State<'a> {
    scene: Option<&'a Scene>,
    /// Shape `[n_observation]`.
    observation: &'a [f32],
    caption: String,
}

struct Channels {
    scene: Option<Channel<SceneUpdate>>,
    bodies: Option<BodyChannels>,
    log: Channel<Log>,
    transition: Channel<pb::Transition>,
    stats: Channel<pb::Stats>,
    outcome: Channel<pb::Outcome>,
}

/// Channels of tasks that the simulator has.
struct BodyChannels {
    tf: Channel<FrameTransforms>,
    joint_states: Channel<JointStates>,
}

impl Channels {
    /// Writes metadata and channels to the start of `file` and flushes it.
    fn start(
        file: &mut LogFile,
        metadata: &EpisodeMetadata,
        has_scene: bool,
    ) -> mcap::McapResult<Self> {
        file.write_metadata(METADATA_NAME, metadata.to_map())?;
        let scene = if has_scene { Some(Channel::open(file, "/scene")?) } else { None };
        let bodies = match metadata.task.as_built_in() {
            Some(_) => Some(BodyChannels {
                tf: Channel::open(file, "/tf")?,
                joint_states: Channel::open(file, "/joint_states")?,
            }),
            None => None,
        };
        let channels = Self {
            scene,
            bodies,
            log: Channel::open(file, "/log")?,
            transition: Channel::open(file, TRANSITION_TOPIC)?,
            stats: Channel::open(file, "/stats")?,
            outcome: Channel::open(file, OUTCOME_TOPIC)?,
        };
        file.flush()?;
        Ok(channels)
    }
}

fn transition_message(task: &TaskSpec, step: &TransitionRecord<'_>) -> pb::Transition {
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
        achieved_goal: task.achieved_goal(step.observation).collect(),
        budget_left: step.budget_left,
    }
}

/// Names who acts for each arm.
fn acting(task: &TaskSpec, advised_arms: u8) -> Vec<String> {
    let name = |arm: ArmIndex| if advised_arms >> arm.0 & 1 == 1 { "teacher" } else { "student" };
    task.arms().map(|arm| name(arm).to_owned()).collect()
}

/// Returns the distance of each object from its goal, metres.
fn goal_distances_m(scene: &Scene) -> Vec<f32> {
    scene
        .objects
        .iter()
        .zip(&scene.goals)
        .map(|(object, goal)| distance(&object.centre, goal))
        .collect()
}
