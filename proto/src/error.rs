//! What a decoder says when it refuses a message.

use std::fmt::Display;

/// A field that does not hold what it must.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{field}: expected {expected}, got {got}")]
pub struct DecodeError {
    /// Path of the field from the message's root, as in `steps[0].observation`.
    pub field: String,
    /// What the field must hold.
    pub expected: String,
    /// What came instead.
    pub got: String,
}

impl DecodeError {
    /// An error about `field`: it must hold `expected` and held `got`.
    pub fn new(field: impl Into<String>, expected: impl Display, got: impl Display) -> Self {
        Self { field: field.into(), expected: expected.to_string(), got: got.to_string() }
    }

    /// The same error seen from the message that holds the erring one in field `parent`.
    #[must_use]
    pub fn within(mut self, parent: impl Display) -> Self {
        self.field = format!("{parent}.{}", self.field);
        self
    }

    /// A sub-message that is not there.
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
    fn an_error_names_the_whole_path() {
        let error = DecodeError::new("observation", "56 numbers", "55 numbers").within("steps[3]");
        assert_eq!(error.to_string(), "steps[3].observation: expected 56 numbers, got 55 numbers");
        let status = tonic::Status::from(error);
        assert_eq!(status.code(), tonic::Code::InvalidArgument);
        assert_eq!(status.message(), "steps[3].observation: expected 56 numbers, got 55 numbers");
    }
}
