//! `tandem policy`: shows policies, symmetrises them, and converts them from and to ONNX.

mod onnx;
mod show;
mod symmetrize;

use crate::cli::PolicyCommand;
use crate::exit::Failed;

pub(crate) fn policy(command: PolicyCommand) -> Result<(), Failed> {
    match command {
        PolicyCommand::Show(args) => show::show(&args),
        PolicyCommand::Export(args) => onnx::export(&args),
        PolicyCommand::Import(args) => onnx::import(&args),
        PolicyCommand::Symmetrize(args) => symmetrize::symmetrize(&args),
    }
}
