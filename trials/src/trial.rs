//! Trials: tests of a trained policy on arms that differ from the training world.
//!
//! A trial draws a start and goals as the training world does and places blocks of their true size on the simulated
//! pair's table ([`rehearsal`]). [`TrialMode::OpenLoop`] follows the paper (section 4.3): the policy's whole episode in
//! the training world becomes one motion, which is planned, checked and executed without observing the objects. Unlike
//! the paper, it rehearses several episodes and executes the most robust one. [`TrialMode::ClosedLoop`] queries the
//! policy before every step with the measurements of cameras and encoders; each step is planned and checked as a
//! separate motion, from rest to rest. [`TrialMode::Twin`] is an open loop whose motion was computed by a closed loop
//! on a copy of the pair. All modes use the same executor and envelope. [`outcome`] then evaluates the final positions
//! of the objects.
//!
//! [`mapping`] relates the policy's world to the table.

use glam::DVec3;
use tandem_core::scene::Scene;
use tandem_core::{Contacts, Layout};
use tandem_kinematics::{Joints, Waypoint};
use tandem_sim::SimError;

use crate::simulated::{Block, SimulatedConfig};
use tandem_bridge::driver::PairState;
use tandem_bridge::executor::Phase;

pub use mapping::Mapping;
pub use outcome::{FailureCause, MotionRefusal, ObjectResult};
pub use rehearsal::{Rehearsal, Rollout, TrialStart};
pub use runner::TrialRunner;
pub use training_hand::TrainingHand;

pub mod mapping;
pub mod outcome;
pub mod rehearsal;

mod block_avoidance;
mod closed_loop;
mod coordination;
mod copies;
mod noise;
mod open_loop;
mod rig;
mod robustness;
mod runner;
mod shared_object;
mod training_hand;

/// Chooses the actions of a trial.
pub trait ActionSource {
    /// Writes the action for one observation and goal, each element in [−1, 1]. Shapes: `[n_observation]`, `[n_goal]`
    /// and `[n_action]` of the layout.
    fn act(&mut self, observation: &[f32], goal: &[f32], action: &mut [f32]);
}

impl<F: FnMut(&[f32], &[f32], &mut [f32])> ActionSource for F {
    fn act(&mut self, observation: &[f32], goal: &[f32], action: &mut [f32]) {
        self(observation, goal, action);
    }
}

/// The way in which a trial uses the policy.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TrialMode {
    /// One motion, computed from an episode in the training world.
    OpenLoop,
    /// One motion, computed by a closed loop on a copy of the pair without noise, with the shortest latency and 20 %
    /// less friction.
    Twin,
    /// One motion per step, with an observation of the table before each.
    ClosedLoop,
}

impl TrialMode {
    /// The mode's name in tables and files.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::OpenLoop => "open-loop",
            Self::Twin => "twin",
            Self::ClosedLoop => "closed-loop",
        }
    }
}

/// The configuration of a series of trials.
#[derive(Debug, Clone, PartialEq)]
pub struct TrialConfig {
    /// The task and the number of arms.
    pub layout: Layout,
    /// The way in which the policy is used.
    pub mode: TrialMode,
    /// The size and mass of the blocks. Their positions and rotations are drawn.
    pub block: Block,
    /// Half the edge of the blocks that the policy was trained with, metres:
    /// [`TRAINED_HALF_M`](mapping::TRAINED_HALF_M), or that of `block` if their sizes varied. The policy perceives
    /// blocks and openings as those of such a block.
    pub trained_half_m: f64,
    /// The largest number of rehearsals of an open loop in the training world, at least 1. If it is greater than 1 and
    /// none is robust, as many may follow in the closed loop on copies of the pair. The most robust one is executed.
    /// Arms that share an object rehearse once.
    pub n_rehearsals: u32,
    /// The seed of starts, goals, latencies and noise.
    pub seed: u64,
    /// The share of the highest speed, in (0, 1].
    pub speed: f64,
    /// The simulated pair. Each trial sets its own seed and blocks.
    pub simulated: SimulatedConfig,
    /// The longest trial, seconds of simulated time at full speed.
    pub time_limit_s: f64,
}

/// The result of a trial.
#[derive(Debug, Clone, PartialEq)]
pub struct TrialReport {
    /// The trial's number.
    pub number: u64,
    /// The cause of a failure; `None` is success.
    pub cause: Option<FailureCause>,
    /// The results of the objects in the arm frames, arm by arm.
    pub objects: Vec<ObjectResult>,
    /// The positions of the objects in the world frame, arm by arm.
    pub positions: Vec<ObjectPositions>,
    /// The distance from a goal up to which it counts as achieved, metres.
    pub tolerance_m: f64,
    /// The distances of the objects from their goals after the rehearsal, metres; `None` in a closed loop.
    pub rehearsed_m: Option<Vec<f64>>,
    /// The duration of the trial, seconds of simulated time.
    pub duration_s: f64,
    /// The number of steps, including those in which hands only withdrew.
    pub n_steps: usize,
    /// The number of steps that the arms did not carry out in full; 0 without a closed loop.
    pub n_shortened: usize,
    /// All contacts of the arms.
    pub touched: Contacts,
    /// The smallest gap between the arms, metres: negative if their capsules overlapped, infinite with one arm.
    pub arms_gap_m: f64,
    /// The smallest gap between an arm and the table, metres.
    pub table_gap_m: f64,
    /// The waypoints of the tools; empty if no motion was planned.
    pub waypoints: Vec<Waypoint>,
    /// The measured and planned positions of the tools, 25 times per second.
    pub path: Vec<PathPoint>,
}

/// The positions of one object, world frame, metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ObjectPositions {
    /// The initial position.
    pub start: DVec3,
    /// The goal.
    pub goal: DVec3,
    /// The final position.
    pub end: DVec3,
}

/// The measured and planned positions of the tools at one time; world frame, metres.
#[derive(Debug, Clone, PartialEq)]
pub struct PathPoint {
    /// Simulated time since the trial's start, seconds.
    pub time_s: f64,
    /// The positions by the motion, arm by arm; empty while there is none.
    pub planned: Vec<DVec3>,
    /// The true positions, arm by arm.
    pub measured: Vec<DVec3>,
}

/// The state of a trial at one time, for observers.
#[derive(Debug)]
pub struct Frame<'a> {
    /// Simulated time since the trial's start, seconds.
    pub time_s: f64,
    /// The phase of the executor.
    pub phase: Phase,
    /// The true scene.
    pub scene: Scene,
    /// The joint angles by the motion, radians, while there is one.
    pub planned: Option<&'a [Joints]>,
    /// The newest reported state of the arms.
    pub measured: Option<&'a PairState>,
    /// The planned and true positions of the tools.
    pub tools: &'a PathPoint,
}

/// Receives the frames of a trial while it runs.
pub trait TrialObserver {
    /// Receives the next frame. Called 25 times per simulated second.
    fn on_frame(&mut self, frame: &Frame<'_>);
}

/// An observer that ignores all frames.
#[derive(Debug, Clone, Copy)]
pub struct NoObserver;

impl TrialObserver for NoObserver {
    fn on_frame(&mut self, _: &Frame<'_>) {}
}

/// The reason why a trial could not be carried out.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TrialError {
    /// The training world cannot be built or has failed.
    #[error("the training world failed")]
    World(#[from] SimError),
    /// The blocks are too large for the tasks' area.
    #[error("no start has room for blocks with half an edge of {half_m} m")]
    NoRoom {
        /// Half the edge of a block, metres.
        half_m: f64,
    },
    /// An arm cannot reach the start of the trial.
    #[error("arm {arm} cannot reach the start of the trial")]
    Start {
        /// The arm, from 0.
        arm: usize,
        /// The reason.
        source: tandem_kinematics::ReachError,
    },
    /// The executor refuses to reset the arms.
    #[error("the arms were not reset")]
    Reset(#[from] tandem_bridge::executor::ResetError),
}

#[cfg(test)]
pub(crate) fn test_config(task: tandem_core::Task, mode: TrialMode, seed: u64) -> TrialConfig {
    TrialConfig {
        layout: Layout::new(task, 2),
        mode,
        block: Block::small([0.0; 2]),
        trained_half_m: 0.028,
        n_rehearsals: 1,
        seed,
        speed: 1.0,
        simulated: SimulatedConfig::default(),
        time_limit_s: 120.0,
    }
}
