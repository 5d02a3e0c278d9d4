//! Exit codes that mean something, and the one line a person reads when something is wrong.

use std::process::ExitCode;

use rustix::io::Errno;
use tandem_core::text::error_chain;

use crate::output;

/// How the program ends when it is not done (sysexits.h).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Exit {
    /// Wrong command line or configuration.
    Usage = 64,
    /// Input that cannot be used: a damaged file, say.
    Data = 65,
    /// A bug.
    Bug = 70,
    /// The result cannot be written to standard output.
    Output = 74,
    /// A peer cannot be reached, a disk is full: try again.
    TryAgain = 75,
    /// Interrupted; the state is saved.
    Interrupted = 130,
    /// Standard output has no reader any more, as behind `| head`. The code that a shell gives a process ended by SIGPIPE.
    Unread = 141,
}

impl Exit {
    /// The exit code of a write that failed. A place that can never be written is a mistake of the command line; for
    /// everything else, such as a full disk, another attempt may help.
    fn of_write(error: &anyhow::Error) -> Self {
        use std::io::ErrorKind as Kind;
        let is_final = |error: &std::io::Error| {
            let kind = error.kind();
            matches!(kind, Kind::NotFound | Kind::AlreadyExists | Kind::NotADirectory)
                || matches!(kind, Kind::IsADirectory | Kind::InvalidFilename)
                || matches!(kind, Kind::PermissionDenied | Kind::InvalidInput)
                || Errno::from_io_error(error) == Some(Errno::LOOP)
        };
        let mut causes = error.chain().filter_map(|cause| cause.downcast_ref::<std::io::Error>());
        if causes.any(is_final) { Self::Usage } else { Self::TryAgain }
    }
}

impl From<Exit> for ExitCode {
    fn from(exit: Exit) -> Self {
        Self::from(exit as u8)
    }
}

/// What went wrong and the exit code that says so.
#[derive(Debug)]
pub(crate) struct Failed {
    exit: Exit,
    error: anyhow::Error,
}

impl Failed {
    pub(crate) fn new(exit: Exit, error: impl Into<anyhow::Error>) -> Self {
        Self { exit, error: error.into() }
    }

    /// A write that failed.
    pub(crate) fn of_write(error: impl Into<anyhow::Error>) -> Self {
        let error = error.into();
        Self { exit: Exit::of_write(&error), error }
    }

    pub(crate) fn usage(message: impl std::fmt::Display) -> Self {
        Self::new(Exit::Usage, anyhow::anyhow!("{message}"))
    }

    /// The same failure, with `what` said before it.
    pub(crate) fn context(self, what: String) -> Self {
        Self { error: self.error.context(what), ..self }
    }

    /// The error without its exit code, for those who tell of it themselves.
    pub(crate) fn into_error(self) -> anyhow::Error {
        self.error
    }

    /// Prints the one line and gives the exit code.
    pub(crate) fn report(&self) -> ExitCode {
        if !matches!(self.exit, Exit::Interrupted | Exit::Unread) {
            output::message(format_args!("tandem: {}", error_chain(self.error.as_ref())));
        }
        self.exit.into()
    }
}

/// Says which exit code an error means.
pub(crate) trait OrExit<T> {
    /// Ends with `exit`, saying `what` was attempted.
    fn or_exit(self, exit: Exit, what: impl FnOnce() -> String) -> Result<T, Failed>;

    /// Ends with the exit code that the error of a write means, saying `what` was attempted.
    fn or_cannot_write(self, what: impl FnOnce() -> String) -> Result<T, Failed>;
}

impl<T, E: Into<anyhow::Error>> OrExit<T> for Result<T, E> {
    fn or_exit(self, exit: Exit, what: impl FnOnce() -> String) -> Result<T, Failed> {
        self.map_err(|error| failed(exit, error.into(), what()))
    }

    fn or_cannot_write(self, what: impl FnOnce() -> String) -> Result<T, Failed> {
        self.map_err(|error| {
            let Failed { exit, error } = Failed::of_write(error);
            failed(exit, error, what())
        })
    }
}

fn failed(exit: Exit, error: anyhow::Error, what: String) -> Failed {
    Failed { exit, error: if what.is_empty() { error } else { error.context(what) } }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_place_that_can_never_be_written_is_not_tried_again() {
        let check = |errno: Errno, expected| {
            let error = anyhow::Error::new(std::io::Error::from(errno)).context("cannot write x");
            assert_eq!(Exit::of_write(&error), expected, "{errno:?}");
        };
        let never = [
            Errno::NOENT,
            Errno::EXIST,
            Errno::NOTDIR,
            Errno::ISDIR,
            Errno::ACCESS,
            Errno::PERM,
            Errno::LOOP,
            Errno::NAMETOOLONG,
        ];
        never.into_iter().for_each(|errno| check(errno, Exit::Usage));
        let later = [Errno::NOSPC, Errno::DQUOT, Errno::FBIG, Errno::IO, Errno::ROFS, Errno::MFILE];
        later.into_iter().for_each(|errno| check(errno, Exit::TryAgain));
    }
}
