//! The house keeps its order: who may depend on whom, which modules stay pure, what no file may say.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

const ALLOWED: [(&str, &[&str]); 15] = [
    ("core", &[]),
    ("system", &[]),
    ("kinematics", &["core"]),
    ("sim", &["core"]),
    ("policy", &["core", "system"]),
    ("proto", &["core"]),
    ("telemetry", &["core", "system"]),
    ("net", &["core"]),
    ("rl", &["core", "policy"]),
    ("learner", &["core", "system", "policy", "rl", "proto", "telemetry", "net"]),
    ("teacher", &["core", "policy", "proto", "telemetry", "net"]),
    ("worker", &["core", "sim", "policy", "proto", "telemetry", "net"]),
    ("report", &["core", "system", "telemetry"]),
    ("bridge", &["core", "kinematics", "proto", "net"]),
    ("trials", &["core", "kinematics", "sim", "policy", "telemetry", "bridge"]),
];

/// Directories of which every file is pure, and single pure files.
const PURE: [&str; 25] = [
    "core/src",
    "kinematics/src",
    "sim/src",
    "policy/src",
    "rl/src",
    "bridge/src/driver.rs",
    "bridge/src/executor.rs",
    "bridge/src/executor",
    "bridge/src/kinova_ros/fingers.rs",
    "bridge/src/kinova_ros/merge.rs",
    "bridge/src/kinova_ros/node.rs",
    "bridge/src/kinova_ros/protocol.rs",
    "bridge/src/quarc/codec.rs",
    "bridge/src/quarc/state_buffer.rs",
    "bridge/src/work_cell.rs",
    "bridge/src/service/execution.rs",
    "bridge/src/service/clock.rs",
    "bridge/src/service/reason_codes.rs",
    "learner/src/work_queue.rs",
    "teacher/src/budget.rs",
    "teacher/src/maps.rs",
    "teacher/src/procedures.rs",
    "teacher/src/strategy.rs",
    "trials/src",
    "worker/src/rollout.rs",
];

#[test]
fn crates_depend_only_downward() {
    for (name, allowed) in ALLOWED {
        let ours: BTreeSet<String> = dependencies(name)
            .iter()
            .filter_map(|d| d.strip_prefix("tandem-").map(str::to_owned))
            .collect();
        let surplus: Vec<_> = ours.iter().filter(|d| !allowed.contains(&d.as_str())).collect();
        assert!(surplus.is_empty(), "{name} must not depend on {surplus:?}");
    }
}

#[test]
fn pure_modules_name_no_runtime() {
    for path in PURE.iter().flat_map(|path| rust_files(&root().join(path))) {
        let text = fs::read_to_string(&path).expect("readable");
        for word in ["tokio", "tonic", "async fn", "prost", "anyhow", "Instant::now", "SystemTime"]
        {
            assert!(!text.contains(word), "{} must not contain `{word}`", path.display());
        }
    }
}

/// `println!` and `eprintln!` panic where nothing can be written.
#[test]
fn one_module_prints() {
    let dirs =
        ALLOWED.iter().map(|(name, _)| root().join(name).join("src")).chain([root().join("src")]);
    let printer = root().join("src/output.rs");
    let is_test = |path: &Path| path.iter().any(|part| part == "tests");
    let files = dirs.flat_map(|dir| rust_files(&dir));
    for path in files.filter(|path| *path != printer && !is_test(path)) {
        let text = fs::read_to_string(&path).expect("readable");
        let program = text.split("#[cfg(test)]").next().unwrap_or_default();
        for word in ["print!(", "println!(", "stdout()", "stderr().lock()"] {
            assert!(!program.contains(word), "{} must not contain `{word}`", path.display());
        }
    }
}

#[test]
fn files_stay_readable() {
    let dirs =
        ALLOWED.iter().map(|(name, _)| root().join(name).join("src")).chain([root().join("src")]);
    for path in dirs.flat_map(|dir| rust_files(&dir)) {
        let n_lines = fs::read_to_string(&path).expect("readable").lines().count();
        assert!(n_lines <= 700, "{} has {n_lines} lines: split it", path.display());
    }
}

#[test]
fn the_image_is_of_this_version_and_toolchain() {
    let read = |name: &str| fs::read_to_string(root().join(name)).expect("readable");
    let toolchain = read("rust-toolchain.toml");
    let channel = toolchain.lines().find_map(|line| line.strip_prefix("channel = "));
    let channel = channel.expect("a channel").trim_matches('"');
    let dockerfile = read("deploy/Dockerfile");
    assert!(dockerfile.contains(&format!("FROM rust:{channel}-slim-")), "not Rust {channel}");
    let image = format!("image: tandem:{}\n", env!("CARGO_PKG_VERSION"));
    assert!(read("compose.yaml").contains(&image), "compose.yaml lacks {image:?}");
    // The image is built from what is listed here, and from nothing else.
    let context = read(".dockerignore");
    for name in
        ALLOWED.map(|(name, _)| name).iter().chain(&["src", "build.rs", "policies", "Cargo.lock"])
    {
        assert!(context.lines().any(|line| line == format!("!{name}")), "no {name} in the context");
    }
}

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// The Rust files below a directory, or the file itself.
fn rust_files(path: &Path) -> Vec<PathBuf> {
    if path.is_file() {
        return vec![path.to_owned()];
    }
    let entries = fs::read_dir(path).expect("a directory of sources");
    let below = entries.flatten().map(|entry| entry.path());
    below
        .filter(|path| path.is_dir() || path.extension().is_some_and(|e| e == "rs"))
        .flat_map(|path| rust_files(&path))
        .collect()
}

/// Names in the `[dependencies]` table of a crate's manifest.
fn dependencies(crate_dir: &str) -> BTreeSet<String> {
    let manifest = root().join(crate_dir).join("Cargo.toml");
    let text = fs::read_to_string(&manifest).expect("a manifest");
    text.lines()
        .skip_while(|line| line.trim() != "[dependencies]")
        .skip(1)
        .take_while(|line| !line.starts_with('['))
        .filter_map(|line| line.split(['.', '=', ' ']).next())
        .filter(|name| !name.is_empty() && !name.starts_with('#'))
        .map(str::to_owned)
        .collect()
}
