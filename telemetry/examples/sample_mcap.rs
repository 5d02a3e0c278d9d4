//! Writes a made-up episode to the MCAP file named on the command line, to try readers on.

use std::path::PathBuf;

#[path = "../tests/support/synthetic.rs"]
mod synthetic;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let path =
        std::env::args_os().nth(1).map(PathBuf::from).ok_or("which file shall be written?")?;
    synthetic::write_log(&path)?;
    Ok(())
}
