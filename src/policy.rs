//! `tandem policy`: shows policies, and converts them from and to ONNX.

mod onnx;
mod show;

use crate::cli::PolicyCommand;
use crate::exit::Failed;

pub(crate) fn policy(command: PolicyCommand) -> Result<(), Failed> {
    match command {
        PolicyCommand::Show(args) => show::show(&args),
        PolicyCommand::Export(args) => onnx::export(&args),
        PolicyCommand::Import(args) => onnx::import(&args),
    }
}
