//! The error of decoders.

use std::fmt::Display;

/// A field of a message has an invalid value.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{field}: expected {expected}, got {got}")]
pub struct DecodeError {
    /// Path of the field from the root of the message, such as `steps[0].observation`.
    pub field: String,
    /// Valid values.
    pub expected: String,
    /// The received value.
    pub got: String,
}

impl DecodeError {
    /// Creates an error about `field`, which must be `expected` and is `got`.
    pub fn new(field: impl Into<String>, expected: impl Display, got: impl Display) -> Self {
        Self { field: field.into(), expected: expected.to_string(), got: got.to_string() }
    }

    /// Prefixes the field's path with `parent`, the field of the enclosing message.
    #[must_use]
    pub fn within(mut self, parent: impl Display) -> Self {
        self.field = format!("{parent}.{}", self.field);
        self
    }

    /// Creates the error of a missing sub-message.
    pub(crate) fn missing(field: &str) -> Self {
        Self::new(field, "a message", "none")
    }
}

impl From<DecodeError> for tonic::Status {
    fn from(error: DecodeError) -> Self {
        Self::invalid_argument(error.to_string())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_error_contains_the_path_of_the_field() {
        let error = DecodeError::new("observation", "56 numbers", "55 numbers").within("steps[3]");
        assert_eq!(error.to_string(), "steps[3].observation: expected 56 numbers, got 55 numbers");
        let status = tonic::Status::from(error);
        assert_eq!(status.code(), tonic::Code::InvalidArgument);
        assert_eq!(status.message(), "steps[3].observation: expected 56 numbers, got 55 numbers");
    }
}
