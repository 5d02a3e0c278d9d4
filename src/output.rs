//! What the program prints: results on standard output, everything else on standard error. No other module prints.
//!
//! A result that cannot be written is an error with an exit code of its own. Messages that cannot be written are dropped:
//! no run and no service ends because of them.

use std::fmt::Display;
use std::io::{self, ErrorKind, Write as _};
use std::time::Duration;

use tandem_telemetry::standard_error;

use crate::exit::{Exit, Failed};

/// How long the end of the program waits for messages to be written.
const LAST_MESSAGES: Duration = Duration::from_secs(2);

/// Prints a line of a command's result.
///
/// # Errors
/// When standard output cannot be written or has no reader.
pub(crate) fn print(line: impl Display) -> Result<(), Failed> {
    let text = escaped(&format!("{line}\n"));
    let mut output = io::stdout().lock();
    checked(output.write_all(text.as_bytes()).and_then(|()| output.flush()))
}

/// Prints what the command line asked for: `--help` or `--version`.
///
/// # Errors
/// As for [`print()`].
pub(crate) fn print_help(help: &clap::Error) -> Result<(), Failed> {
    checked(help.print().and_then(|()| io::stdout().flush()))
}

fn checked(written: io::Result<()>) -> Result<(), Failed> {
    written.map_err(|error| match error.kind() {
        ErrorKind::BrokenPipe => Failed::new(Exit::Unread, error),
        _ => {
            let error = anyhow::Error::new(error).context("cannot write to standard output");
            Failed::new(Exit::Output, error)
        }
    })
}

/// Adds a line to standard error, without waiting.
pub(crate) fn message(line: impl Display) {
    standard_error::write_line(&escaped(&line.to_string()));
}

/// Waits a while until messages are written: what the end of the program must not cut off.
pub(crate) fn finish() {
    standard_error::flush(LAST_MESSAGES);
}

/// The text with its control characters escaped: what files and peers say must not steer a terminal.
pub(crate) fn escaped(text: &str) -> String {
    let mut shown = String::with_capacity(text.len());
    for character in text.chars() {
        match character {
            '\n' | '\t' => shown.push(character),
            character if character.is_control() => shown.extend(character.escape_default()),
            character => shown.push(character),
        }
    }
    shown
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn control_characters_are_escaped_and_lines_stay_lines() {
        assert_eq!(escaped("a\tb\nc"), "a\tb\nc");
        assert_eq!(escaped("\u{1b}[31mred\u{9b}0m\r\u{7}"), "\\u{1b}[31mred\\u{9b}0m\\r\\u{7}");
        assert_eq!(escaped("smallest–largest, ü"), "smallest–largest, ü");
    }
}
