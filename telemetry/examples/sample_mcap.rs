//! Writes a synthetic episode to the MCAP file given on the command line, to test readers. Writes an episode of a
//! task that is not built-in to the second file, if there is one.

use std::path::PathBuf;

#[path = "../tests/support/synthetic.rs"]
mod synthetic;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut paths = std::env::args_os().skip(1).map(PathBuf::from);
    synthetic::write_log(&paths.next().ok_or("usage: sample_mcap FILE [DESCRIBED]")?)?;
    if let Some(path) = paths.next() {
        synthetic::write_described_log(&path, &synthetic::described(3))?;
    }
    Ok(())
}
