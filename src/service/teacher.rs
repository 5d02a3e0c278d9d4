//! `tandem teacher`.

use std::ffi::OsString;
use std::path::{Path, PathBuf};

use tandem_net::{ClientConfig, Pacing};
use tandem_teacher::ledger::{self, Ledger, OpenError, SqliteLedger};
use tandem_teacher::policy;
use tandem_teacher::{Advisor, AnyPolicy, Error, PolicyTimeouts, RemoteError, RemotePolicy};

use super::{listen, run};
use crate::cli::TeacherArgs;
use crate::exit::{Exit, Failed};
use crate::{access, metrics, policy_file, signals};

pub(crate) fn teacher(args: TeacherArgs) -> Result<(), Failed> {
    let source = PolicySource::new(&args.policy, args.critic)?;
    let own = metrics::of_process("teacher");
    let server_config =
        access::server_config(&args.listen, &args.secret)?.with_metrics(own.clone());
    let client_config =
        access::client_config(&args.client_config, &args.secret)?.with_metrics(own.clone());
    run(async move {
        let shutdown = signals::shutdown_token(args.listen.exit_with_stdin)?;
        let opened = async {
            let policy = source.open(&client_config).await.map_err(teacher_failed)?;
            check_digest(&policy, args.policy_digest.as_deref())?;
            let ledger = open_ledger(args.ledger).map_err(teacher_failed)?;
            let advisor = Advisor::new(policy, ledger).map_err(teacher_failed)?;
            Ok(if args.exit_for_restart { advisor.ending_for_restart() } else { advisor })
        };
        let advisor = tokio::select! {
            advisor = opened => advisor?,
            () = shutdown.cancelled() => return Ok(()),
        };
        metrics::serve(&args.metrics, &own).await?;
        let listener = listen(&args.listen).await?;
        let served = tandem_teacher::serve_advisor(
            advisor,
            listener,
            &server_config,
            shutdown,
            Pacing::Concurrent,
        )
        .await;
        served.map_err(teacher_failed)
    })
}

/// The kind of a policy, as the command line names it.
enum PolicySource {
    /// A policy file, or an ONNX model with its critic.
    File { policy: PathBuf, critic: Option<PathBuf> },
    /// The address of a server of `tandem.v1.Policy`.
    Server(String),
}

impl PolicySource {
    /// Distinguishes URLs from files, and checks files before anything is bound.
    fn new(policy: &Path, critic: Option<PathBuf>) -> Result<Self, Failed> {
        match policy_address(policy) {
            Some(_) if critic.is_some() => Err(teacher_failed(Error::SurplusCritic)),
            Some(address) => Ok(Self::Server(address.to_owned())),
            None => {
                let policy = policy_file::file_of(policy)?.into_owned();
                policy::load(&policy, critic.as_deref()).map_err(teacher_failed)?;
                Ok(Self::File { policy, critic })
            }
        }
    }

    async fn open(&self, client_config: &ClientConfig) -> Result<AnyPolicy, Error> {
        match self {
            Self::File { policy, critic } => Ok(policy::load(policy, critic.as_deref())?.into()),
            Self::Server(address) => {
                let timeouts = PolicyTimeouts::default();
                Ok(RemotePolicy::connect(address, client_config, timeouts).await?.into())
            }
        }
    }
}

/// Rejects a policy with another digest than the command line requires.
fn check_digest(policy: &AnyPolicy, required: Option<&str>) -> Result<(), Failed> {
    match required.filter(|required| *required != policy.digest()) {
        Some(required) => Err(Failed::usage(format!(
            "the policy has digest {}, not {required} as --policy-digest requires: serve that policy",
            policy.digest()
        ))),
        None => Ok(()),
    }
}

/// Returns the address of the server that a policy's place on the command line names, if it is a URL.
pub(crate) fn policy_address(policy: &Path) -> Option<&str> {
    policy.to_str().filter(|text| text.starts_with("http://") || text.starts_with("https://"))
}

/// Opens the ledger. A ledger whose name is not UTF-8 can only be a file.
fn open_ledger(ledger: OsString) -> Result<Box<dyn Ledger>, Error> {
    match ledger.into_string() {
        Ok(location) => Ok(ledger::open(&location)?),
        Err(file) => Ok(Box::new(SqliteLedger::open(Path::new(&file))?)),
    }
}

/// Chooses the exit code of a teacher's error.
pub(crate) fn teacher_failed(error: Error) -> Failed {
    use Error as E;
    let exit = match &error {
        E::OpenLedger(OpenError::InvalidLocation(_) | OpenError::BadPath { .. }) => Exit::Usage,
        E::OpenLedger(OpenError::InUse(_) | OpenError::Io { .. } | OpenError::Server { .. }) => {
            Exit::TryAgain
        }
        E::RemotePolicy(RemoteError::Unavailable { .. }) => Exit::TryAgain,
        E::RemotePolicy(RemoteError::Address(_) | RemoteError::Refused { .. }) => Exit::Usage,
        E::LedgerNeedsRestart | E::Transport(_) | E::Thread(_) => Exit::TryAgain,
        // The files are intact, but the command line names the wrong ones.
        E::NotOneArm { .. } | E::NotAnArm(_) | E::NotOneValue { .. } | E::NotACritic { .. } => {
            Exit::Usage
        }
        E::SurplusCritic | E::NoValues { .. } | E::ServerConfig(_) => Exit::Usage,
        E::Panicked => Exit::Bug,
        _ => Exit::Data,
    };
    Failed::new(exit, error)
}
