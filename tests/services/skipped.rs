//! Tests that are left out where the machine lacks something.

use std::path::Path;
use std::process::Command;

/// Reports with `scripts/skip` what is not tested and why.
///
/// # Panics
/// If the environment requires it: `TANDEM_REQUIRE_{switch}` or `TANDEM_REQUIRE_ALL` is 1.
pub(crate) fn skip(switch: &str, text: &str) {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("scripts/skip");
    let status = Command::new(script).args([switch, text]).status().expect("runs");
    assert!(status.success(), "{text}, and TANDEM_REQUIRE_{switch} or TANDEM_REQUIRE_ALL is 1");
}
