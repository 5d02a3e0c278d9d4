//! Errors of reading, running, importing and exporting models.

use std::path::PathBuf;

/// An error of reading a model from a file.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The file cannot be read.
    #[error("cannot read ONNX file {path:?}")]
    Read {
        /// The file.
        path: PathBuf,
        /// Error of the operating system.
        source: std::io::Error,
    },
    /// The file was read but does not contain a usable model.
    #[error("{path:?} is not a usable ONNX model")]
    Refused {
        /// The file.
        path: PathBuf,
        /// The reason.
        source: Box<ModelError>,
    },
}

/// The reason why a model is refused.
#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    /// The bytes are not a Protobuf message.
    #[error("it is not a complete ONNX file")]
    NotOnnx,
    /// The file is larger, or has more parts, than a policy can have.
    #[error("it has {got} {what}, expected at most {most}")]
    TooLarge {
        /// The parts that are counted.
        what: &'static str,
        /// Its number.
        got: usize,
        /// The largest accepted number.
        most: usize,
    },
    /// The model has no graph, or uses an unsupported version of the operators.
    #[error("{0}")]
    Model(String),
    /// A node is not supported.
    #[error("node {node:?} ({operator}): {problem}")]
    Node {
        /// The node's name, or that of its first output.
        node: String,
        /// The node's operator.
        operator: String,
        /// The property that is not supported, and the supported ones.
        problem: String,
    },
    /// A tensor is not supported.
    #[error("tensor {tensor:?}: {problem}")]
    Tensor {
        /// The tensor's name.
        tensor: String,
        /// The property that is not supported, and the supported ones.
        problem: String,
    },
    /// An input or output of the model does not fit the task or the role.
    #[error("{kind} {name:?}: {problem}")]
    Value {
        /// `input` or `output`.
        kind: &'static str,
        /// The value's name.
        name: String,
        /// The fault, and the expected value.
        problem: String,
    },
    /// The network is valid, but a policy file cannot represent it.
    #[error("a policy file cannot represent it: {0}")]
    NotRepresentable(String),
    /// The policy has invalid sizes or numbers.
    #[error(transparent)]
    Policy(#[from] tandem_policy::Error),
}
