//! Writes policies for the browser demo, which asks for actions and never for values: their critics are zeros, which compress to
//! nothing. `actors DIR policies/student-push.safetensors ...`

use std::path::PathBuf;

use tandem_policy::Policy;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut paths = std::env::args_os().skip(1).map(PathBuf::from);
    let directory = paths.next().ok_or("usage: actors DIR FILE.safetensors...")?;
    for path in paths {
        let mut policy = Policy::from_bytes(&std::fs::read(&path)?)?;
        policy.critic.fill(0.0);
        std::fs::write(directory.join(path.file_name().unwrap_or_default()), policy.to_bytes()?)?;
    }
    Ok(())
}
