//! What a policy is: actor and critic networks, their gradients, Adam, input normalisation, and the policy file.
//!
//! Parameters of a network are one flat `f32` vector; every function states the shapes it works on. Nothing here
//! knows an environment, a replay buffer or a wire format, and nothing but [`Policy::save`] and [`Policy::load`]
//! touches a file.
//!
//! Reading order: [`mlp`] (shape, forward and backward pass over batches), [`adam`], [`normalizer`], [`inference`]
//! ([`Actor`] and [`Critic`], the same bits on every machine), [`policy`] and [`mod@file`] (the whole of it on disk).
#![warn(missing_docs)]

pub mod adam;
mod copies;
mod elementwise;
mod error;
pub mod file;
pub mod inference;
pub mod matrix;
pub mod mlp;
pub mod normalizer;
mod packed;
pub mod policy;

pub use adam::{Adam, polyak_update};
pub use elementwise::{all_finite, tanh};
pub use error::{Error, FormatError};
pub use inference::{Actor, Critic};
pub use matrix::{Matrix, MatrixMut, multiply};
pub use mlp::{MlpShape, Workspace, backward_input, backward_parameters, forward};
pub use normalizer::{Normalizer, NormalizerParts, NormalizerSnapshot};
pub use policy::{Policy, actor_digest};
