//! Messages of calls that failed, with the command that helps.

use anyhow::anyhow;
use tandem_net::{NOTHING_LISTENS, WrongService};
use tonic::{Code, Status};

use crate::exit::{Exit, Failed};

/// Returns the failure of a call. `advice` is what to do if nothing listens at the address; empty for no advice.
pub(crate) fn failed(exit: Exit, status: &Status, advice: &str) -> Failed {
    let message = status.message();
    match hint(status, advice) {
        Some(hint) => Failed::new(exit, anyhow!("{message}; {hint}")),
        None => Failed::new(exit, anyhow!("{message}")),
    }
}

fn hint(status: &Status, advice: &str) -> Option<String> {
    if status.code() == Code::Unavailable && status.message().ends_with(NOTHING_LISTENS) {
        return (!advice.is_empty()).then(|| advice.to_owned());
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
    fn a_call_that_nothing_answers_gets_the_advice() {
        let refused = Status::unavailable(format!("x:1 does not answer: {NOTHING_LISTENS}"));
        assert_eq!(hint(&refused, "start it").as_deref(), Some("start it"));
        assert_eq!(hint(&refused, ""), None);
        let broken = Status::unavailable("x:1 does not answer: connection reset");
        assert_eq!(hint(&broken, "start it"), None);
    }
}
