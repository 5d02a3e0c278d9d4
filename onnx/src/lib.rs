//! ONNX models of policies: export for other runtimes, and import of networks that were trained elsewhere.
//!
//! - [`export`] writes a [`Policy`](tandem_policy::Policy) as a model of the actor or of the critic, with the
//!   normalisation of its inputs.
//! - [`Model`] reads a model, within bounds that a hostile file cannot exceed. Only multilayer perceptrons over
//!   observation, goal and action are accepted; an error names the node, its operator and what is supported.
//! - [`BoundNetwork`] runs a model on the vectors of a [`Layout`](tandem_core::Layout).
//! - [`import()`] converts models to a policy, if a policy file can represent them.
//!
//! The crate contains the part of ONNX that it needs and depends on no ONNX runtime. `docs/onnx.md` describes the
//! models.
//!
//! ```
//! use tandem_onnx::{BoundNetwork, Model, Role, export};
//! use tandem_policy::Policy;
//!
//! let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../policies/teacher-push-classic.safetensors");
//! let policy = Policy::load(path.as_ref())?;
//! let model = Model::decode(&export::actor(&policy)?)?;
//! let mut actor = BoundNetwork::new(&model, Role::Actor, &policy.task)?;
//!
//! let (observation, goal) = ([0.0; 28], [0.1, 0.0, 0.02]);
//! let (mut action, mut expected) = ([0.0; 3], [0.0; 3]);
//! actor.run(&observation, &goal, &[], &mut action);
//! policy.actor()?.act(&observation, &goal, &mut expected);
//! assert!(action.iter().zip(expected).all(|(got, expected)| (got - expected).abs() < 1e-5));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! # Modules in reading order
//!
//! [`export`] and [`metadata`]; [`scan`] (bounds), [`model`], [`graph`] (from a graph to a network), [`network`],
//! [`binding`], [`mod@import`].
#![warn(missing_docs)]

pub mod binding;
mod error;
pub mod export;
pub mod graph;
pub mod import;
pub mod metadata;
pub mod model;
pub mod network;
mod onnx_proto;
pub mod scan;

pub use binding::{BoundNetwork, Role};
pub use error::{Error, ModelError};
pub use import::import;
pub use model::Model;
pub use network::Network;
