//! The simulated environments: push and pick and place with one arm or two, and two arms that carry a bar.
//!
//! An [`Env`] starts episodes, writes observations and executes actions. All environments share one implementation; a
//! [`Layout`](tandem_core::Layout) selects the task and the number of arms. The crate knows nothing of policies, advice
//! or rewards: `tandem_policy` chooses actions, and [`tandem_core::reward`] computes rewards from observations.
//!
//! # An episode
//!
//! This program plays one episode with random actions:
//!
//! ```
//! use tandem_core::layout::EPISODE_STEPS;
//! use tandem_core::reward::{achieved_goal, sparse_reward};
//! use tandem_core::{Layout, Stream, Task, WorldSettings, episode_rng, rng};
//! use tandem_sim::{Env, WorldConfig};
//!
//! let layout = Layout::new(Task::Push, 2);
//! let mut env = Env::new(layout, &WorldConfig::default())?;
//! let mut observation = vec![0.0; layout.n_observation()];
//! let mut action = vec![0.0; layout.n_action()];
//!
//! // The initial state depends on the seed (1), the episode (0) and the stream only.
//! env.reset(&mut episode_rng(1, 0, Stream::Reset), WorldSettings::default());
//! let mut exploration = episode_rng(1, 0, Stream::Exploration);
//! let mut episode_return = 0.0;
//! for _ in 0..EPISODE_STEPS {
//!     action.fill_with(|| rng::uniform(&mut exploration, -1.0, 1.0));
//!     env.step(&action)?;
//!     env.observe(&mut observation);
//!     let achieved: Vec<f32> = achieved_goal(layout, &observation).collect();
//!     episode_return += sparse_reward(&achieved, env.goal());
//! }
//! assert!((-50.0..=0.0).contains(&episode_return));
//! # Ok::<(), tandem_sim::SimError>(())
//! ```
//!
//! # Observations, goals and actions
//!
//! All vectors are `f32` slices that concatenate the parts of each arm, in the arm's own frame:
//!
//! | vector | per arm | contents |
//! |---|---|---|
//! | observation | 28 | hand, object, fingers and their velocities; [`Env::observe`] lists them |
//! | goal | 3 | desired position of the object, metres |
//! | action | 3 or 4 | displacement in units of 5 cm, in tasks of grasping also the gripper; see [`Env::step`] |
//!
//! An action of 1 along x moves the end effector away from the arm's base, for either arm:
//!
//! ```
//! # use tandem_core::{Layout, Stream, Task, WorldSettings, episode_rng};
//! # use tandem_sim::{Env, WorldConfig};
//! let mut env = Env::new(Layout::new(Task::Push, 1), &WorldConfig::default())?;
//! env.reset(&mut episode_rng(1, 0, Stream::Reset), WorldSettings::default());
//! let (mut before, mut after) = ([0.0; 28], [0.0; 28]);
//! env.observe(&mut before);
//! env.step(&[1.0, 0.0, 0.0])?;
//! env.observe(&mut after);
//! assert!(after[0] > before[0] + 0.02, "at least 2 of 5 cm within the 0.04 s of a step");
//! # Ok::<(), tandem_sim::SimError>(())
//! ```
//!
//! [`Env::step`] returns [`Contacts`](tandem_core::Contacts): whether the arms touched each other or the table.
//! [`Env::scene`] returns the poses of all bodies in the world frame, for pictures and logs.
//!
//! # Configuration
//!
//! [`WorldConfig`] sets the resolution of the physics, the objects and their friction.
//! [`WorldSettings`](tandem_core::WorldSettings), a section of the run file, sets how often training episodes start
//! with grasped objects and how much the world varies between them. Values out of range are errors:
//!
//! ```
//! # use tandem_core::{Layout, Task};
//! # use tandem_sim::{Env, WorldConfig};
//! let coarse = WorldConfig { substeps: 5, ..WorldConfig::default() };
//! let error = Env::new(Layout::new(Task::Push, 1), &coarse).err().expect("too coarse");
//! assert_eq!(error.to_string(), "world.substeps is 5, expected a number from 10 to 80");
//! ```
//!
//! # Determinism
//!
//! Equal draws and actions give equal bits, on any thread and any x86-64 machine. The crate reads no clock, no thread
//! number and no address, and takes trigonometric functions from `libm`. [`Env::reset`] clones a world that was never
//! stepped, so earlier episodes have no influence.
//!
//! # Implementation in reading order
//!
//! `env` (the interface), `world` and `physics` (a rapier world for bodies of centimetres), `hand` (palm and fingers,
//! moved by forces), `arm` and `kinematics` (the joints of a Jaco follow the hand by inverse kinematics), `mico` (a
//! Mico's posture, in closed form), `capsule` and `link_avoidance` (a velocity damper between the links of two arms),
//! `frame`, `observation`, `start` (initial states), `scene` and `description` (the world as data).
#![warn(missing_docs)]

mod arm;
mod bar;
mod capsule;
mod config;
pub mod description;
mod env;
mod frame;
mod hand;
mod kinematics;
mod link_avoidance;
mod mico;
mod observation;
mod parameters;
mod physics;
mod randomization;
pub mod reach;
mod scene;
mod start;
mod world;

pub use config::{Friction, SimError, WorldConfig};
pub use env::Env;
