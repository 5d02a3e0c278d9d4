//! Messages of calls that failed, with the command that helps.

use anyhow::anyhow;
use tandem_net::{NOTHING_LISTENS, WrongService};
use tonic::{Code, Status};

use crate::exit::{Exit, Failed};

/// Returns the failure of a call. `start` is the command that starts a service of the called kind; empty for no advice.
pub(crate) fn failed(exit: Exit, status: &Status, start: &str) -> Failed {
    let message = status.message();
    match hint(status, start) {
        Some(hint) => Failed::new(exit, anyhow!("{message}; {hint}")),
        None => Failed::new(exit, anyhow!("{message}")),
    }
}

fn hint(status: &Status, start: &str) -> Option<String> {
    if status.code() == Code::Unavailable && status.message().ends_with(NOTHING_LISTENS) {
        if start.is_empty() {
            return None;
        }
        return Some(format!("start one with `{start}`"));
    }
    let WrongService { name, address } = WrongService::of(status)?;
    Some(match name.as_str() {
        "learner" => format!("`tandem status {address}` shows a learner's run"),
        "bridge" => format!("`tandem bridge status --connect {address}` shows a bridge's arms"),
        _ => format!("`tandem health {address}` checks any service"),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_call_that_nothing_answers_names_the_command_that_starts_the_service() {
        let refused = Status::unavailable(format!("x:1 does not answer: {NOTHING_LISTENS}"));
        assert_eq!(hint(&refused, "tandem y").as_deref(), Some("start one with `tandem y`"));
        assert_eq!(hint(&refused, ""), None);
        let broken = Status::unavailable("x:1 does not answer: connection reset");
        assert_eq!(hint(&broken, "tandem y"), None);
    }
}
