//! Prints the digests of policies by task, as JSON: `digests policies/student-push.safetensors ...`
#![expect(clippy::print_stdout, reason = "a program that prints its result")]

use std::path::PathBuf;

use serde_json::{Map, Value};
use tandem_demo::digest::digest;
use tandem_policy::Policy;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut digests = Map::new();
    for path in std::env::args_os().skip(1).map(PathBuf::from) {
        let policy = Policy::from_bytes(&std::fs::read(path)?)?;
        digests.insert(policy.layout.name().to_owned(), Value::String(digest(&policy)?));
    }
    println!("{:#}", Value::Object(digests));
    Ok(())
}
