//! `tandem teacher`.

use std::ffi::OsString;
use std::path::{Path, PathBuf};

use tandem_net::Pacing;
use tandem_teacher::ledger::{OpenError, SqliteLedger};
use tandem_teacher::policy;
use tandem_teacher::{Advisor, Error};

use super::{listen, run};
use crate::cli::TeacherArgs;
use crate::exit::{Exit, Failed};
use crate::{access, signals};

pub(crate) fn teacher(args: TeacherArgs) -> Result<(), Failed> {
    policy::load(&args.policy, args.critic.as_deref()).map_err(teacher_failed)?;
    let server_config = access::server_config(&args.listen, &args.secret)?;
    run(async move {
        let shutdown = signals::shutdown_token(args.listen.exit_with_stdin)?;
        let advisor = advisor(args.policy, args.critic, args.ledger).map_err(teacher_failed)?;
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

/// Opens the teacher's policy with its ledger. A ledger whose name is not UTF-8 can only be a file.
fn advisor(policy: PathBuf, critic: Option<PathBuf>, ledger: OsString) -> Result<Advisor, Error> {
    match ledger.into_string() {
        Ok(ledger) => tandem_teacher::open(&tandem_teacher::Config { policy, critic, ledger }),
        Err(file) => {
            let policy = policy::load(&policy, critic.as_deref())?;
            Advisor::new(policy, Box::new(SqliteLedger::open(Path::new(&file))?))
        }
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
        E::Transport(_) | E::Thread(_) => Exit::TryAgain,
        E::SurplusCritic => Exit::Usage,
        E::Panicked => Exit::Bug,
        _ => Exit::Data,
    };
    Failed::new(exit, error)
}
