//! Trials: whether what a policy learned in the training world works on other arms.
//!
//! A trial draws a start and goals as the training world does and puts blocks of their true size on the simulated pair's table
//! ([`rollout`]). [`Mode::OpenLoop`] is the paper's way (section 4.3): the policy's whole episode in the training world becomes one
//! motion, which is planned, checked and executed without a look at the objects. [`Mode::ClosedLoop`] asks the policy
//! again after every step, with what the cameras and encoders say; each step is planned and checked as a motion of its own, from rest to
//! rest. [`Mode::Twin`] is an open loop whose motion was made by a closed loop on a copy of the pair: blind too, but made for these
//! arms. The executor's envelope is the same for all. [`judge`] then looks at where the objects are.
//!
//! [`mapping`] says how the policy's world lies on the table.

use glam::DVec3;
use tandem_core::scene::Scene;
use tandem_core::{Contacts, Layout};
use tandem_kinematics::{Joints, WayPoint};
use tandem_sim::SimError;

use crate::simulated::{Block, SimulatedConfig};
use tandem_bridge::driver::PairState;
use tandem_bridge::executor::Phase;

pub use judge::{Cause, ObjectCourse, RefusedBy};
pub use mapping::Mapping;
pub use rollout::{Rehearsal, Rollout, TrialStart};
pub use run::Trials;

pub mod judge;
pub mod mapping;
pub mod rollout;

mod closed;
mod run;
mod shape;
mod stage;

/// Whoever decides what the arms do.
pub trait Decide {
    /// Writes the action for one observation and goal, each in [−1, 1]. Shapes: those of the layout, one row.
    fn decide(&mut self, observation: &[f32], goal: &[f32], action: &mut [f32]);
}

impl<F: FnMut(&[f32], &[f32], &mut [f32])> Decide for F {
    fn decide(&mut self, observation: &[f32], goal: &[f32], action: &mut [f32]) {
        self(observation, goal, action);
    }
}

/// Whether the policy sees what its actions come to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Mode {
    /// One motion, made of an episode in the training world.
    OpenLoop,
    /// One motion, made of a closed loop on a copy of the pair that differs from it as a model does from the arms.
    Twin,
    /// A look at the table before every step.
    ClosedLoop,
}

impl Mode {
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

/// What trials have in common.
#[derive(Debug, Clone, PartialEq)]
pub struct TrialConfig {
    /// Task and number of arms.
    pub layout: Layout,
    /// Whether the policy sees the table.
    pub mode: Mode,
    /// The blocks; where they lie is drawn.
    pub block: Block,
    /// Decides starts, goals, latencies and noise.
    pub seed: u64,
    /// Share of the fastest speed, in (0, 1].
    pub speed: f64,
    /// The simulated pair, whose seed and blocks are the trial's.
    pub simulated: SimulatedConfig,
    /// Longest trial, seconds of simulated time at full speed.
    pub time_limit_s: f64,
}

/// What happened in a trial.
#[derive(Debug, Clone, PartialEq)]
pub struct TrialReport {
    /// The trial's number.
    pub number: u64,
    /// Why it failed; `None` is success.
    pub cause: Option<Cause>,
    /// What happened to each object, arm by arm.
    pub objects: Vec<ObjectCourse>,
    /// Where the objects lay, should go and ended in the world, arm by arm.
    pub places: Vec<Places>,
    /// How far from their goals the objects were after the rehearsal, metres; not in the closed loop.
    pub rehearsed_m: Option<Vec<f64>>,
    /// How long the arms took, seconds of simulated time.
    pub duration_s: f64,
    /// Steps that the policy was asked for.
    pub n_steps: usize,
    /// Steps that the check allowed in part or not at all; closed loop only.
    pub n_shortened: usize,
    /// What touched what.
    pub touched: Contacts,
    /// The smallest gap between the arms that was measured, metres.
    pub arms_gap_m: f64,
    /// The smallest gap between an arm and the table, metres.
    pub table_gap_m: f64,
    /// Where the tools went, or should have gone, from way point to way point; empty when nothing could be planned.
    pub way_points: Vec<WayPoint>,
    /// Where the tools were and where the motion had them, some twenty times a second.
    pub path: Vec<PathPoint>,
}

/// An object's places, world frame, metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Places {
    /// Where it lay at first.
    pub start: DVec3,
    /// Where it should go.
    pub goal: DVec3,
    /// Where it ended.
    pub end: DVec3,
}

/// Where the tools were at one time and where they should have been; world frame, metres.
#[derive(Debug, Clone, PartialEq)]
pub struct PathPoint {
    /// Simulated time since the trial's start, seconds.
    pub time_s: f64,
    /// By the motion, arm by arm; empty while there is none.
    pub planned: Vec<DVec3>,
    /// In truth.
    pub measured: Vec<DVec3>,
}

/// The table at one moment, for whoever keeps records.
#[derive(Debug)]
pub struct Look<'a> {
    /// Simulated time since the trial's start, seconds.
    pub time_s: f64,
    /// What the executor does.
    pub phase: Phase,
    /// Everything as it truly is.
    pub scene: Scene,
    /// Where the motion has the joints, radians, while there is one.
    pub planned: Option<&'a [Joints]>,
    /// What the arms said last.
    pub measured: Option<&'a PairState>,
    /// Where the tools are by the motion and in truth.
    pub tools: &'a PathPoint,
}

/// Somebody who watches a trial.
pub trait Witness {
    /// The table some twenty-five times a second.
    fn look(&mut self, look: &Look<'_>);
}

/// Nobody watches.
#[derive(Debug, Clone, Copy)]
pub struct NoWitness;

impl Witness for NoWitness {
    fn look(&mut self, _: &Look<'_>) {}
}

/// Why a trial could not be carried out at all.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TrialError {
    /// The training world cannot be built or broke.
    #[error("the training world failed")]
    World(#[from] SimError),
    /// The blocks are too large for the tasks' area.
    #[error("no start has room for blocks with half an edge of {half_m} m")]
    NoRoom {
        /// Half an edge, metres.
        half_m: f64,
    },
    /// The arms cannot be where the trial starts.
    #[error("arm {arm} cannot be where the trial starts")]
    Start {
        /// The arm, from 0.
        arm: usize,
        /// Why not.
        source: tandem_kinematics::ReachError,
    },
    /// The executor does not let the arms go.
    #[error("the arms were not let go")]
    Reset(#[from] tandem_bridge::executor::ResetError),
}
