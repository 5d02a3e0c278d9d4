//! `tandem mcap`: repairs MCAP logs.

use std::path::PathBuf;

use tandem_telemetry::Error;

use crate::cli::{McapArgs, McapCommand};
use crate::exit::{Exit, Failed, OrExit as _};
use crate::output;

pub(crate) fn mcap(args: &McapArgs) -> Result<(), Failed> {
    let McapCommand::Recover { file, to } = &args.command;
    let to = to.clone().unwrap_or_else(|| {
        let mut name = file.clone().into_os_string();
        name.push(".recovered.mcap");
        PathBuf::from(name)
    });
    if to.exists() {
        return Err(Failed::usage(format!(
            "{} exists: choose another file with --to",
            to.display()
        )));
    }
    let recovered = tandem_telemetry::recover(file, &to);
    let counts = match recovered {
        Err(Error::WriteLog { .. }) => recovered.or_cannot_write(String::new),
        _ => recovered.or_exit(Exit::Data, String::new),
    }?;
    output::print(format_args!(
        "recovered {} messages of {} into {}",
        counts.messages,
        file.display(),
        to.display()
    ))?;
    if let Some(cause) = &counts.ended_by {
        let file = file.display();
        output::message(format_args!("tandem: the rest of {file} cannot be read: {cause}"));
    }
    Ok(())
}
