//! Version and commit of this program.

/// Version and commit, for `--version`, the learner and the bridge.
pub(crate) const VERSION: &str = env!("TANDEM_VERSION");
