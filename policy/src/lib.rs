//! Policies: actor and critic networks, their gradients, the Adam optimiser, input normalisation and the policy file.
//!
//! The crate knows no environment, replay buffer or wire format, and draws random numbers only from generators that it
//! is given. Only [`Policy::load`] and [`Policy::save`] access files.
//!
//! # Running a policy
//!
//! A [`Policy`] contains both networks, the normalisation of their inputs and the [task](tandem_core::TaskSpec) for
//! which it was trained. Its [`Actor`] chooses actions, its [`Critic`] values them:
//!
//! ```
//! use tandem_policy::Policy;
//!
//! let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../policies/student-push-classic.safetensors");
//! let policy = Policy::load(path.as_ref())?;
//! let (mut actor, mut critic) = (policy.actor()?, policy.critic()?);
//!
//! let observation = vec![0.0; policy.task.n_observation()]; // metres, radians; in arm frames
//! let goal = vec![0.1; policy.task.n_goal()]; // metres, in arm frames
//! let mut action = vec![0.0; policy.task.n_action()];
//! let mut values = vec![0.0; critic.n_heads()];
//! actor.act(&observation, &goal, &mut action);
//! critic.q(&observation, &goal, &action, &mut values);
//! assert!(action.iter().all(|component| component.abs() <= 1.0));
//! # Ok::<(), tandem_policy::Error>(())
//! ```
//!
//! Both take batches, row-major and batch first: observations of shape `[n, n_observation]` give actions of shape `[n,
//! n_action]`. The bits of a row do not depend on the batch it is in, nor on the machine, provided that it has fused
//! multiply-add.
//!
//! # Networks and gradients
//!
//! The parameters of a network are one flat vector, whose layout an [`MlpShape`] describes. [`forward`],
//! [`backward_parameters`] and [`backward_input`] work on batches; [`Adam`] updates parameters, and [`polyak_update`]
//! moves a target network. This program fits a network to `y = x²`:
//!
//! ```
//! use tandem_core::{Stream, episode_rng};
//! use tandem_policy::{Adam, Matrix, MatrixMut, MlpShape, Workspace, backward_parameters, forward};
//!
//! let shape = MlpShape { n_input: 1, n_hidden: 16, n_hidden_layers: 1, n_output: 1 };
//! let mut parameters = shape.initialise(&mut episode_rng(1, 0, Stream::Initialisation));
//! let mut adam = Adam::new(shape.n_parameters(), 0.01);
//! let mut workspace = Workspace::new(&shape, 5);
//!
//! let (x, y) = ([-1.0, -0.5, 0.0, 0.5, 1.0], [1.0, 0.25, 0.0, 0.25, 1.0]);
//! let (mut output, mut gradient) = ([0.0; 5], vec![0.0; shape.n_parameters()]);
//! for _ in 0..500 {
//!     let (input, rows) = (Matrix::new(&x, 5, 1), &mut MatrixMut::new(&mut output, 5, 1));
//!     forward(&shape, &parameters, input, &mut workspace, rows);
//!     let slopes: [f32; 5] = std::array::from_fn(|row| 2.0 * (output[row] - y[row]) / 5.0);
//!     backward_parameters(&shape, &parameters, input, &mut workspace, &slopes, &mut gradient);
//!     adam.step(&mut parameters, &gradient);
//! }
//! assert!((0..5).all(|row| (output[row] - y[row]).abs() < 0.1), "{output:?}");
//! ```
//!
//! # Normalisation
//!
//! A [`Normalizer`] keeps running statistics; its [`NormalizerSnapshot`] is the mean and standard deviation of one
//! moment, which a policy stores.
//!
//! ```
//! use tandem_policy::Normalizer;
//!
//! let mut normalizer = Normalizer::new(2);
//! normalizer.update(&[0.0, 10.0, 2.0, 30.0]); // shape [2, 2]
//! let mut row = [0.0; 2];
//! normalizer.normalize(&[1.0, 30.0], &mut row);
//! assert_eq!(row, [0.0, 1.0]);
//! ```
//!
//! # Files
//!
//! A policy file is a safetensors file with a digest of its tensors; `docs/policy-format.md` specifies it. A file that
//! does not match its sizes, or was altered, is refused with a [`FormatError`] and never reshaped.
//!
//! # Modules in reading order
//!
//! [`mlp`] (shapes, forward and backward passes), [`matrix`], [`adam`], [`normalizer`], [`inference`] ([`Actor`] and
//! [`Critic`]), [`policy`], [`mod@file`].
#![warn(missing_docs)]

pub mod adam;
mod aligned;
mod blind;
mod elementwise;
mod error;
pub mod file;
pub mod inference;
pub mod matrix;
pub mod mlp;
pub mod normalizer;
mod packed;
pub mod policy;
mod replicate;
mod symmetrize;
mod validation;

pub use adam::{Adam, AdamPart, polyak_update};
pub use aligned::AlignedVec;
pub use blind::BlindActor;
pub use elementwise::{all_finite, tanh};
pub use error::{Error, FormatError};
pub use inference::{Actor, Critic, QueryGate};
pub use matrix::{Matrix, MatrixMut, multiply};
pub use mlp::{
    Activations, MlpShape, ParameterBlock, RowBlock, TransposedBlock, TransposedParameters,
    Workspace, backward_input, backward_parameters, elementwise_blocks, forward,
};
pub use normalizer::{Normalizer, NormalizerSnapshot, NormalizerState};
pub use policy::{Policy, actor_digest};
pub use symmetrize::symmetrized_actor;

/// Tests of the public interface, which name this crate as other crates do.
#[cfg(test)]
#[path = "../tests/damaged_files.rs"]
mod damaged_files;
#[cfg(test)]
#[path = "../tests/matrix_bounds.rs"]
mod matrix_bounds;
#[cfg(test)]
extern crate self as tandem_policy;
