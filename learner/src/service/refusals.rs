//! What the service refuses, and how it says so.

use tandem_proto::DecodeError;
use tonic::Status;

use crate::board::SubmitError;

/// Longest label of a worker.
const MAX_NAME_BYTES: usize = 256;
/// Letters of a version that a refusal repeats: it travels in a header.
const MAX_SHOWN_CHARS: usize = 40;
/// The version that workers must have: what an episode is may change with any.
const VERSION: &str = env!("CARGO_PKG_VERSION");

/// Number and label of a worker.
type Worker = (u64, String);

/// Refuses labels that are too long, or that would do something to a terminal or a log.
pub(super) fn check_name(name: &str) -> Result<(), Status> {
    if name.len() > MAX_NAME_BYTES {
        let message =
            format!("worker: expected at most {MAX_NAME_BYTES} bytes, got {}", name.len());
        return Err(Status::invalid_argument(message));
    }
    match name.chars().find(|c| is_control(*c)) {
        None => Ok(()),
        Some(control) => {
            let code = u32::from(control);
            let message =
                format!("worker: expected no control characters, got U+{code:04X} in {name:?}");
            Err(Status::invalid_argument(message))
        }
    }
}

/// Control characters, line separators and those that turn the direction of writing.
fn is_control(c: char) -> bool {
    c.is_control()
        || matches!(c, '\u{200e}' | '\u{200f}' | '\u{2028}'..='\u{202e}' | '\u{2066}'..='\u{2069}')
}

/// Refuses workers of another version than this learner or relay.
pub(crate) fn check_version(name: &str, version: &str, this: &str) -> Result<(), Status> {
    if version == VERSION {
        return Ok(());
    }
    let shown: String = version.chars().take(MAX_SHOWN_CHARS).collect();
    Err(Status::failed_precondition(format!(
        "worker {name:?} is of version {shown:?}, this {this} of version {VERSION:?}: both must be the same"
    )))
}

/// What the sender of a malformed episode is told.
pub(super) fn malformed(error: &DecodeError, episode: u64, worker: Option<&Worker>) -> Status {
    Status::invalid_argument(format!("{}episode {episode}: {error}", prefix(worker)))
}

/// What the board's refusal means to a worker.
pub(super) fn refusal(error: &SubmitError, worker: Option<&Worker>) -> Status {
    match error {
        SubmitError::UnknownWorker(_) => Status::not_found(error.to_string()),
        SubmitError::UnknownSlot { .. }
        | SubmitError::WrongCount { .. }
        | SubmitError::WrongEpisode { .. } => {
            Status::invalid_argument(format!("{}{error}", prefix(worker)))
        }
    }
}

fn prefix(worker: Option<&Worker>) -> String {
    worker.map_or_else(String::new, |(id, name)| format!("worker {name:?} ({id}): "))
}
