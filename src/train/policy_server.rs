//! A server of the teacher's policy: a run keeps its address and the digest of the policy.

use std::path::Path;

use anyhow::{Context as _, anyhow};
use serde::{Deserialize, Serialize};
use tandem_core::TaskSpec;
use tandem_net::ClientConfig;
use tandem_system::atomic_file;
use tandem_teacher::{Error, PolicyTimeouts, RemotePolicy};

use crate::exit::{Exit, Failed, OrExit as _};
use crate::service::teacher_failed;
use crate::{input, runtime};

/// The policy of a server.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub(super) struct PolicyServer {
    /// The URL of the server.
    pub(super) address: String,
    /// The digest of its policy when the run started.
    pub(super) digest: String,
}

/// The policy of a server that answers.
pub(super) struct ServedPolicy {
    pub(super) server: PolicyServer,
    pub(super) task: TaskSpec,
    pub(super) has_values: bool,
}

impl PolicyServer {
    /// Reads the server of a run from the file at `path`.
    pub(super) fn read(path: &Path) -> anyhow::Result<Self> {
        let text = input::text(path).with_context(|| format!("cannot read {path:?}"))?;
        toml::from_str(&text)
            .map_err(|error| anyhow!("{path:?} is damaged: {}", error.message().replace('\n', " ")))
    }

    /// Writes the server to the file at `path`.
    pub(super) fn write(&self, path: &Path) -> Result<(), Failed> {
        let text = toml::to_string(self).or_exit(Exit::Bug, String::new)?;
        let written = atomic_file::replace(path, text.as_bytes());
        written.or_cannot_write(|| format!("cannot write {}", path.display()))
    }

    /// Asks the server for its policy, and rejects one that has changed.
    pub(super) fn connect(self) -> Result<ServedPolicy, Failed> {
        let served = ServedPolicy::of(&self.address)?;
        if served.server == self {
            return Ok(served);
        }
        Err(Failed::usage(format!(
            "the policy at {} has changed since the start of the run (digest {}, not {}): serve the earlier one again, \
             or start a new run",
            self.address, served.server.digest, self.digest
        )))
    }
}

impl ServedPolicy {
    /// Asks the server at `address` for its policy. Waits some seconds for a server that is away.
    pub(super) fn of(address: &str) -> Result<Self, Failed> {
        let runtime = runtime::new().or_exit(Exit::TryAgain, String::new)?;
        let (config, timeouts) = (ClientConfig::default(), PolicyTimeouts::default());
        let policy = runtime.block_on(RemotePolicy::connect(address, &config, timeouts));
        let policy = policy.map_err(|error| teacher_failed(Error::RemotePolicy(error)))?;
        let (address, digest) = (address.to_owned(), policy.digest().to_owned());
        Ok(Self {
            server: PolicyServer { address, digest },
            task: policy.task().clone(),
            has_values: policy.has_values(),
        })
    }
}
