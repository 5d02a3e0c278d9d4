//! Requests that the service refuses, as gRPC statuses.

use tandem_proto::DecodeError;
use tonic::Status;

use crate::work_queue::QueueError;

/// Longest label of a worker.
const MAX_NAME_BYTES: usize = 256;
/// Characters of a version that a refusal repeats: the message is sent in a header.
const MAX_SHOWN_CHARS: usize = 40;
/// The version that workers must have, because any version may change the meaning of an episode.
const VERSION: &str = env!("CARGO_PKG_VERSION");

/// Number and label of a worker.
type Worker = (u64, String);

/// Refuses labels that are too long, or contain characters with an effect on a terminal or a log.
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

/// Returns true for control characters, line separators and characters that change the writing direction.
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

/// Returns the status for a malformed episode.
pub(super) fn malformed(error: &DecodeError, episode: u64, worker: Option<&Worker>) -> Status {
    Status::invalid_argument(format!("{}episode {episode}: {error}", prefix(worker)))
}

/// Returns the status for a refusal of the work queue.
pub(super) fn refusal(error: &QueueError, worker: Option<&Worker>) -> Status {
    match error {
        QueueError::UnknownWorker(_) => Status::not_found(error.to_string()),
        QueueError::UnknownSlot { .. }
        | QueueError::WrongCount { .. }
        | QueueError::WrongEpisode { .. } => {
            Status::invalid_argument(format!("{}{error}", prefix(worker)))
        }
    }
}

fn prefix(worker: Option<&Worker>) -> String {
    worker.map_or_else(String::new, |(id, name)| format!("worker {name:?} ({id}): "))
}
