//! `tandem relay`: hands out a learner's parameters near its workers.

use clap::Args;

use super::{DialArgs, ListenArgs, SecretArgs};

#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  tandem relay --connect learner:7000 --listen 0.0.0.0:7000 --token-file token
  tandem worker --connect relay:7000 --teacher teacher:7001 --token-file token

Workers connect to a relay as they would to the learner. docs/scale.md shows when relays help.")]
pub(crate) struct RelayArgs {
    /// Address of the learner.
    #[arg(long, value_name = "ADDR")]
    pub(crate) connect: String,
    #[command(flatten)]
    pub(crate) listen: ListenArgs,
    #[command(flatten)]
    pub(crate) dial: DialArgs,
    #[command(flatten)]
    pub(crate) secret: SecretArgs,
}
