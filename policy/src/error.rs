//! Errors of creating, reading and writing policies.

use std::path::PathBuf;

/// An error of creating, reading or writing a policy.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A vector does not have the length that follows from the task and the network's sizes.
    #[error("{name} has {got} numbers, expected {expected}")]
    WrongLength {
        /// Name of the vector.
        name: &'static str,
        /// Its length.
        got: usize,
        /// Required length.
        expected: usize,
    },
    /// A parameter is infinite or NaN.
    #[error("{name} holds a number that is not finite")]
    NotFinite {
        /// Name of the vector.
        name: &'static str,
    },
    /// A standard deviation is zero or negative.
    #[error("{name} holds a number that is not above 0")]
    NotPositive {
        /// Name of the vector.
        name: &'static str,
    },
    /// A number of units, layers or heads is out of range.
    #[error("{name} is {got}, expected 1 to {most}")]
    Size {
        /// Name of the size.
        name: &'static str,
        /// Its value.
        got: usize,
        /// Largest accepted value.
        most: usize,
    },
    /// The critic has neither one value nor one for each arm.
    #[error("n_heads is {got}, expected 1 or the number of arms, {n_arms}")]
    Heads {
        /// Number of values.
        got: usize,
        /// Number of arms.
        n_arms: usize,
    },
    /// The file cannot be read.
    #[error("cannot read policy file {path:?}")]
    Read {
        /// The file.
        path: PathBuf,
        /// Error of the operating system.
        source: std::io::Error,
    },
    /// The file cannot be written. An existing file at this path is unchanged.
    #[error("cannot write policy file {path:?}")]
    Write {
        /// The file.
        path: PathBuf,
        /// Error of the operating system.
        source: std::io::Error,
    },
    /// The file was read but does not contain a valid policy.
    #[error("{path:?} is not a usable policy file")]
    Refused {
        /// The file.
        path: PathBuf,
        /// The reason.
        source: Box<FormatError>,
    },
}

/// The reason why a file is not a valid policy file.
#[derive(Debug, thiserror::Error)]
pub enum FormatError {
    /// The file is not a safetensors file, or it is truncated.
    #[error("not a complete safetensors file")]
    NotSafetensors {
        /// Error of the parser.
        source: safetensors::SafeTensorError,
    },
    /// A required metadata entry is missing.
    #[error("metadata {key:?} is missing")]
    MissingMetadata {
        /// Key of the entry.
        key: &'static str,
    },
    /// A metadata entry has a value that this version does not support.
    #[error("metadata {key:?} is {got:?}, expected {expected}")]
    Metadata {
        /// Key of the entry.
        key: &'static str,
        /// Its value.
        got: String,
        /// Supported values.
        expected: String,
    },
    /// A tensor is missing.
    #[error("tensor {name:?} is missing")]
    MissingTensor {
        /// Name of the tensor.
        name: String,
    },
    /// A tensor is not part of the format. It is not ignored, because it could change the policy's behaviour.
    #[error("tensor {name:?} is unknown")]
    UnknownTensor {
        /// Name of the tensor.
        name: String,
    },
    /// A tensor does not have the type or shape that follows from the sizes.
    #[error("tensor {name:?} is {got}, expected {expected}")]
    TensorShape {
        /// Name of the tensor.
        name: String,
        /// Its type and shape.
        got: String,
        /// Required type and shape.
        expected: String,
    },
    /// A size or a number is invalid.
    #[error(transparent)]
    Unusable(#[from] Error),
    /// The tensors were changed after the file was written.
    #[error("the tensors' digest is {got}, the file was written with {expected}")]
    Digest {
        /// Digest of the tensors as read.
        got: String,
        /// Digest in the metadata.
        expected: String,
    },
}
