//! Exit codes, and errors that determine one.

use std::process::ExitCode;

use rustix::io::Errno;
use tandem_core::text::error_chain;

/// Exit codes of a program that fails (sysexits.h).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Exit {
    /// Wrong command line or configuration.
    Usage = 64,
    /// Unusable input, such as a damaged file.
    Data = 65,
    /// A bug.
    Bug = 70,
    /// The result cannot be written to standard output.
    Output = 74,
    /// A temporary failure: a peer is unreachable, a disk is full.
    TryAgain = 75,
    /// Interrupted; the state is saved.
    Interrupted = 130,
    /// The reader of standard output has closed it, as `head` does. Shells report this code for SIGPIPE.
    Unread = 141,
}

impl Exit {
    /// Returns the exit code of a failed write. A path that can never be written is a mistake on the command line; for
    /// other errors, such as a full disk, another attempt may succeed.
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

/// An error and the exit code of the program.
#[derive(Debug)]
pub(crate) struct Failed {
    exit: Exit,
    error: anyhow::Error,
}

impl Failed {
    pub(crate) fn new(exit: Exit, error: impl Into<anyhow::Error>) -> Self {
        Self { exit, error: error.into() }
    }

    /// A failed write, with the exit code that fits its cause.
    pub(crate) fn of_write(error: impl Into<anyhow::Error>) -> Self {
        let error = error.into();
        Self { exit: Exit::of_write(&error), error }
    }

    pub(crate) fn usage(message: impl std::fmt::Display) -> Self {
        Self::new(Exit::Usage, anyhow::anyhow!("{message}"))
    }

    /// Adds `what` before the error.
    pub(crate) fn context(self, what: String) -> Self {
        Self { error: self.error.context(what), ..self }
    }

    /// Returns the error without its exit code.
    pub(crate) fn into_error(self) -> anyhow::Error {
        self.error
    }

    pub(crate) const fn exit(&self) -> Exit {
        self.exit
    }

    /// Returns the error and its causes on one line.
    pub(crate) fn line(&self) -> String {
        error_chain(self.error.as_ref())
    }
}

/// Attaches exit codes to errors.
pub(crate) trait OrExit<T> {
    /// Attaches `exit`, and `what` as context unless it is empty.
    fn or_exit(self, exit: Exit, what: impl FnOnce() -> String) -> Result<T, Failed>;

    /// Attaches the exit code of a failed write, and `what` as context unless it is empty.
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
    fn paths_that_can_never_be_written_are_usage_errors() {
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
