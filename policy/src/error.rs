//! What can go wrong with a policy.

use std::path::PathBuf;

/// Why a policy cannot be made, read or written.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A vector does not have the length that the layout and the network's sizes ask for.
    #[error("{name} has {got} numbers, expected {expected}")]
    WrongLength {
        /// Which vector.
        name: &'static str,
        /// Its length.
        got: usize,
        /// What the sizes ask for.
        expected: usize,
    },
    /// A parameter is infinite or NaN.
    #[error("{name} holds a number that is not finite")]
    NotFinite {
        /// Which vector.
        name: &'static str,
    },
    /// A standard deviation is zero or negative.
    #[error("{name} holds a number that is not above 0")]
    NotPositive {
        /// Which vector.
        name: &'static str,
    },
    /// A network has no units, no layers, no heads, or absurdly many.
    #[error("{name} is {got}, expected 1 to {most}")]
    Size {
        /// Which size.
        name: &'static str,
        /// Its value.
        got: usize,
        /// The largest that is accepted.
        most: usize,
    },
    /// The file cannot be read.
    #[error("cannot read policy file {path:?}")]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The file cannot be written; an older one under the same name is untouched.
    #[error("cannot write policy file {path:?}")]
    Write {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The file was read but is no policy that can be used.
    #[error("{path:?} is not a usable policy file")]
    Refused {
        /// The file.
        path: PathBuf,
        /// Why.
        source: Box<FormatError>,
    },
}

/// Why the bytes of a file are no policy.
#[derive(Debug, thiserror::Error)]
pub enum FormatError {
    /// Not a safetensors file, or one that was cut short.
    #[error("not a whole safetensors file")]
    NotSafetensors {
        /// What the parser said.
        source: safetensors::SafeTensorError,
    },
    /// A metadata entry that every policy file has is missing.
    #[error("metadata {key:?} is missing")]
    MissingMetadata {
        /// The entry.
        key: &'static str,
    },
    /// A metadata entry has a value that this version cannot use.
    #[error("metadata {key:?} is {got:?}, expected {expected}")]
    Metadata {
        /// The entry.
        key: &'static str,
        /// Its value.
        got: String,
        /// What it may be.
        expected: String,
    },
    /// A tensor is missing.
    #[error("tensor {name:?} is missing")]
    MissingTensor {
        /// The tensor.
        name: String,
    },
    /// A tensor is none of this format's: ignoring it could change what the policy does.
    #[error("tensor {name:?} is unknown")]
    UnknownTensor {
        /// The tensor.
        name: String,
    },
    /// A tensor has another type or shape than the sizes ask for.
    #[error("tensor {name:?} is {got}, expected {expected}")]
    TensorShape {
        /// The tensor.
        name: String,
        /// Its type and shape.
        got: String,
        /// What the sizes ask for.
        expected: String,
    },
    /// The numbers were read but cannot be used.
    #[error(transparent)]
    Unusable(#[from] Error),
    /// The tensors are not those that were written.
    #[error("the tensors' digest is {got}, the file was written with {expected}")]
    Digest {
        /// Digest of the tensors as read.
        got: String,
        /// Digest in the metadata.
        expected: String,
    },
}
