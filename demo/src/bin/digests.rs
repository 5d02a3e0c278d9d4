//! Prints the digests of policies by task, as JSON: `digests policies/student-push.safetensors ...`
#![expect(clippy::print_stdout, reason = "a program that prints its result")]

use std::path::{Path, PathBuf};
use std::thread;

use serde_json::{Map, Value};
use tandem_demo::digest::digest;
use tandem_policy::Policy;

type Error = Box<dyn std::error::Error + Send + Sync>;

fn main() -> Result<(), Error> {
    let paths: Vec<_> = std::env::args_os().skip(1).map(PathBuf::from).collect();
    let digests: Result<Map<_, _>, Error> = thread::scope(|scope| {
        // All start before the first is waited for: an emulator needs a minute for each.
        let running: Vec<_> = paths.iter().map(|path| scope.spawn(|| entry(path))).collect();
        running
            .into_iter()
            .map(|it| it.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)))
            .collect()
    });
    println!("{:#}", Value::Object(digests?));
    Ok(())
}

/// Returns the name of the policy's task and the policy's digest.
fn entry(path: &Path) -> Result<(String, Value), Error> {
    let policy = Policy::from_bytes(&std::fs::read(path)?)?;
    Ok((policy.task.name().to_owned(), Value::String(digest(&policy)?)))
}
