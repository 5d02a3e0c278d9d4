//! Output: results go to standard output, everything else to standard error. No other module prints.
//!
//! A result that cannot be written is an error with its own exit code. Messages that cannot be written are dropped, so
//! they end no run and no service.

use std::fmt::{Display, Write as _};
use std::io::{self, ErrorKind, IsTerminal as _, Write as _};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use tandem_telemetry::standard_error;

use crate::exit::{Exit, Failed};

/// Time that the program waits at its end for messages to be written.
const FLUSH_TIMEOUT: Duration = Duration::from_secs(2);

/// Prints a line of a command's result.
///
/// # Errors
/// When standard output cannot be written or has no reader.
pub(crate) fn print(line: impl Display) -> Result<(), Failed> {
    let text = escaped(&format!("{line}\n"));
    let mut output = io::stdout().lock();
    checked(output.write_all(text.as_bytes()).and_then(|()| output.flush()))
}

/// Prints the text of `--help` or `--version`.
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

/// Returns true if both standard output and standard error are terminals.
pub(crate) fn is_terminal() -> bool {
    io::stdout().is_terminal() && io::stderr().is_terminal()
}

/// Writes a line to standard error without waiting.
pub(crate) fn message(line: impl Display) {
    standard_error::write_line(&escaped(&line.to_string()));
}

/// Prints an error as one line on standard error and returns its exit code. Interruptions are not reported.
pub(crate) fn report(failed: &Failed) -> ExitCode {
    if !matches!(failed.exit(), Exit::Interrupted | Exit::Unread) {
        message(format_args!("tandem: {}", failed.line()));
    }
    failed.exit().into()
}

/// Rejects a file that cannot be written because it is a directory. To be called before the work whose result it gets.
pub(crate) fn check_is_no_directory(file: &Path) -> Result<(), Failed> {
    match file.is_dir() {
        true => {
            let message = format!("cannot write {}: it is a directory", file.display());
            Err(Failed::usage(message))
        }
        false => Ok(()),
    }
}

/// Rejects a file that cannot be created because there is no directory for it, or that is one. To be called before the
/// work whose result it gets.
pub(crate) fn check_directory_of(file: &Path) -> Result<(), Failed> {
    check_is_no_directory(file)?;
    match file.parent().filter(|parent| !parent.as_os_str().is_empty()) {
        Some(parent) if !parent.is_dir() => Err(Failed::usage(format!(
            "cannot write {}: there is no directory {}",
            file.display(),
            parent.display()
        ))),
        _ => Ok(()),
    }
}

/// Rejects two arguments that name one file: writing one would destroy the other.
pub(crate) fn check_distinct(files: &[(&str, Option<&Path>)]) -> Result<(), Failed> {
    let mut former: Vec<(&str, PathBuf)> = Vec::new();
    for (name, path) in files {
        let Some(path) = path else { continue };
        let file = resolved(path);
        if let Some((other, _)) = former.iter().find(|(_, other)| *other == file) {
            let shown = path.display();
            return Err(Failed::usage(format!(
                "{name} {shown}: {other} is the same file; choose another"
            )));
        }
        former.push((name, file));
    }
    Ok(())
}

/// Rejects outputs that name the file of an input: writing one would destroy it.
pub(crate) fn check_keeps(
    outputs: &[(&str, Option<&Path>)],
    (name, input): (&str, &Path),
) -> Result<(), Failed> {
    outputs.iter().try_for_each(|output| check_distinct(&[(name, Some(input)), *output]))
}

/// Returns the path without links and `..`, as far as it exists.
fn resolved(path: &Path) -> PathBuf {
    let in_directory = || {
        let parent = path.parent().filter(|parent| !parent.as_os_str().is_empty());
        let parent = parent.unwrap_or(Path::new(".")).canonicalize().ok()?;
        Some(parent.join(path.file_name()?))
    };
    path.canonicalize().ok().or_else(in_directory).unwrap_or_else(|| path.to_owned())
}

/// Waits until all messages are written, for at most 2 s.
pub(crate) fn flush_messages() {
    standard_error::flush(FLUSH_TIMEOUT);
}

/// Escapes control characters: text from files and peers must not control the terminal.
pub(crate) fn escaped(text: &str) -> String {
    let mut shown = String::with_capacity(text.len());
    for character in text.chars() {
        match character {
            '\n' | '\t' => shown.push(character),
            '\r' => shown.push_str("\\r"),
            // As in JSON, whose strings may contain such characters.
            character if character.is_control() => {
                let _infallible = write!(shown, "\\u{:04x}", u32::from(character));
            }
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
        assert_eq!(escaped("\u{1b}[31mred\u{9b}0m\r\u{7}"), "\\u001b[31mred\\u009b0m\\r\\u0007");
        assert_eq!(escaped("smallest–largest, ü"), "smallest–largest, ü");
        let text = "a\u{7f}\u{85}\u{1}\"";
        let json = escaped(&serde_json::json!({ "name": text }).to_string());
        assert!(!json.contains(char::is_control), "{json}");
        let read: serde_json::Value = serde_json::from_str(&json).expect("JSON");
        assert_eq!(read["name"], text);
    }
}
