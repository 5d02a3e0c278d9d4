//! Writes a synthetic episode to the MCAP file given on the command line, to test readers.

use std::path::PathBuf;

#[path = "../tests/support/synthetic.rs"]
mod synthetic;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let path = std::env::args_os().nth(1).map(PathBuf::from).ok_or("usage: sample_mcap FILE")?;
    synthetic::write_log(&path)?;
    Ok(())
}
