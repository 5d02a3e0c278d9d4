//! Rules for the source: dependencies between crates and modules, purity, printing and the length of files.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

const ALLOWED: [(&str, &[&str]); 20] = [
    ("core", &[]),
    ("system", &[]),
    ("kinematics", &["core"]),
    ("sim", &["core", "kinematics"]),
    ("picture", &["core"]),
    ("policy", &["core", "system"]),
    ("proto", &["core"]),
    ("telemetry", &["core", "system"]),
    ("net", &["core"]),
    ("rl", &["core", "policy"]),
    ("onnx", &["core", "policy"]),
    ("learner", &["core", "system", "policy", "rl", "proto", "telemetry", "net"]),
    ("teacher", &["core", "policy", "proto", "net", "onnx"]),
    ("worker", &["core", "sim", "policy", "proto", "telemetry", "net"]),
    ("environment", &["core", "sim", "proto", "net"]),
    ("report", &["core", "system", "telemetry"]),
    ("bridge", &["core", "kinematics", "proto", "net"]),
    ("trials", &["core", "kinematics", "sim", "policy", "telemetry", "bridge"]),
    ("bench", &["core", "sim", "policy", "proto", "net", "rl", "teacher"]),
    ("dashboard", &["core", "telemetry", "net"]),
];

/// The Python package, which has a workspace of its own and is in no image.
const PYTHON: (&str, &[&str]) = ("python", &["core", "picture", "sim", "policy", "telemetry"]);
/// The browser demo, which has a workspace of its own as well.
const DEMO: (&str, &[&str]) = ("demo", &["core", "picture", "sim", "policy"]);

/// Directories of which every file is pure, and single pure files.
const PURE: [&str; 31] = [
    "core/src",
    "kinematics/src",
    "picture/src",
    "sim/src",
    "policy/src",
    "rl/src",
    "bridge/src/calibration",
    "bridge/src/cell_file.rs",
    "bridge/src/cell_file",
    "bridge/src/driver.rs",
    "bridge/src/executor.rs",
    "bridge/src/executor",
    "bridge/src/kinova_ros/fingers.rs",
    "bridge/src/kinova_ros/merge.rs",
    "bridge/src/kinova_ros/node.rs",
    "bridge/src/kinova_ros/protocol.rs",
    "bridge/src/quarc/arm_side.rs",
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
    "worker/src/determinism.rs",
    "worker/src/rollout.rs",
];

#[test]
fn crates_depend_only_downward() {
    for (name, allowed) in ALLOWED.into_iter().chain([PYTHON, DEMO]) {
        let ours: BTreeSet<String> = dependencies(name)
            .iter()
            .filter_map(|d| d.strip_prefix("tandem-").map(str::to_owned))
            .collect();
        let surplus: Vec<_> = ours.iter().filter(|d| !allowed.contains(&d.as_str())).collect();
        assert!(surplus.is_empty(), "{name} must not depend on {surplus:?}");
    }
}

#[test]
fn every_dependency_is_used() {
    let crates = ALLOWED.into_iter().chain([PYTHON, DEMO]).map(|(name, _)| name).chain(["."]);
    for name in crates {
        let sources = rust_files(&root().join(name).join("src"));
        let programs: Vec<String> =
            sources.iter().filter(|path| !is_of_tests(path)).map(|path| code_of(path)).collect();
        for dependency in dependencies(name) {
            let prefix = format!("{}::", dependency.replace('-', "_"));
            let is_used = programs.iter().any(|program| !names_after(program, &prefix).is_empty());
            assert!(is_used, "{name} depends on {dependency}, which it does not use");
        }
    }
}

/// Cargo compiles the tests of examples, and does not run them.
#[test]
fn every_test_of_an_example_is_run() {
    let read = |path: &PathBuf| fs::read_to_string(path).expect("readable");
    let tests: Vec<String> = rust_files(&root().join("tests")).iter().map(read).collect();
    let crates = ALLOWED.iter().map(|(name, _)| root().join(name)).chain([root().to_owned()]);
    let examples = crates.map(|path| path.join("examples")).filter(|path| path.is_dir());
    for example in examples.flat_map(|path| rust_files(&path)) {
        let path = example.strip_prefix(root()).expect("below").display().to_string();
        let is_included = tests.iter().any(|test| test.contains(&format!("/{path}\"")));
        let has_tests = read(&example).contains("#[test]");
        assert!(is_included || !has_tests, "no file in tests/ includes {path}, which has tests");
    }
}

#[test]
fn pure_modules_name_no_runtime() {
    for path in PURE.iter().flat_map(|path| rust_files(&root().join(path))) {
        let text = fs::read_to_string(&path).expect("readable");
        for word in ["tokio", "tonic", "async fn", "prost", "anyhow", "Instant::now", "SystemTime"]
        {
            let is_letter = |at: usize| text[..at].ends_with(|c: char| c.is_ascii_alphabetic());
            let is_named = text.match_indices(word).any(|(at, _)| !is_letter(at));
            assert!(!is_named, "{} must not contain `{word}`", path.display());
        }
    }
}

/// `println!` and `eprintln!` panic where nothing can be written.
#[test]
fn one_module_prints() {
    let dirs =
        ALLOWED.iter().map(|(name, _)| root().join(name).join("src")).chain([root().join("src")]);
    let printer = root().join("src/output.rs");
    let files = dirs.flat_map(|dir| rust_files(&dir));
    for path in files.filter(|path| *path != printer && !is_of_tests(path)) {
        let text = fs::read_to_string(&path).expect("readable");
        let program = without_tests(&text);
        for word in ["print!(", "println!(", "stdout()", "stderr().lock()"] {
            assert!(!program.contains(word), "{} must not contain `{word}`", path.display());
        }
    }
}

#[test]
fn files_stay_readable() {
    let crates = ALLOWED.iter().chain([&PYTHON, &DEMO]);
    let dirs = crates.map(|(name, _)| root().join(name).join("src")).chain([root().join("src")]);
    for path in dirs.flat_map(|dir| rust_files(&dir)) {
        let n_lines = fs::read_to_string(&path).expect("readable").lines().count();
        assert!(n_lines <= 500, "{} has {n_lines} lines: split it", path.display());
    }
}

/// Crates without examples spare the tests a pass of rustdoc.
#[test]
fn every_documentation_example_is_tested() {
    for (name, _) in ALLOWED {
        let manifest = fs::read_to_string(root().join(name).join("Cargo.toml")).expect("readable");
        let is_tested = !manifest.lines().any(|line| line.trim() == "doctest = false");
        let has_example = rust_files(&root().join(name).join("src")).iter().any(|path| {
            let text = fs::read_to_string(path).expect("readable");
            let mut lines = text.lines().map(str::trim_start);
            lines.any(|line| line.starts_with("/// ```") || line.starts_with("//! ```"))
        });
        assert_eq!(is_tested, has_example, "{name}: `doctest` of its manifest");
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
    // The image is built only from the paths listed here.
    let context = read(".dockerignore");
    for name in
        ALLOWED.map(|(name, _)| name).iter().chain(&["src", "build.rs", "policies", "Cargo.lock"])
    {
        assert!(context.lines().any(|line| line == format!("!{name}")), "no {name} in the context");
    }
    // Cargo accepts a test whose file is not in the context only if the manifest names the file.
    let of_crates = ALLOWED.map(|(name, _)| format!("{name}/Cargo.toml"));
    for name in of_crates.into_iter().chain(["Cargo.toml".to_owned()]) {
        for test in read(&name).split("\n[").filter_map(|table| table.strip_prefix("[test]]\n")) {
            let has_path = test.lines().any(|line| line.starts_with("path = "));
            assert!(has_path, "{name}: a [[test]] without a path: {test}");
        }
    }
}

/// Other versions of what computes could give other bits.
#[test]
fn workspaces_of_their_own_have_this_version_and_the_same_dependencies() {
    let read = |name: &str| fs::read_to_string(root().join(name)).expect("readable");
    let version = format!("version = \"{}\"\n", env!("CARGO_PKG_VERSION"));
    let ours = read("Cargo.lock");
    let ours = locked_versions(&ours);
    for (directory, _) in [PYTHON, DEMO] {
        let manifest = read(&format!("{directory}/Cargo.toml"));
        assert!(manifest.contains(&version), "{directory}/Cargo.toml lacks {version:?}");
        let lock = read(&format!("{directory}/Cargo.lock"));
        let locked = locked_versions(&lock);
        for (name, versions) in locked.iter().filter(|(name, _)| ours.contains_key(*name)) {
            let surplus: Vec<_> = versions.difference(&ours[name]).collect();
            let expected = &ours[name];
            assert!(
                surplus.is_empty(),
                "{directory}/Cargo.lock has {name} {surplus:?}, not {expected:?}"
            );
        }
    }
}

/// The versions of each package in a lock file.
fn locked_versions(lock: &str) -> BTreeMap<&str, BTreeSet<&str>> {
    let mut versions: BTreeMap<&str, BTreeSet<&str>> = BTreeMap::new();
    for package in lock.split("[[package]]\n").skip(1) {
        let mut values = package.lines().take(2).filter_map(|line| line.split('"').nth(1));
        let (Some(name), Some(version)) = (values.next(), values.next()) else { continue };
        versions.entry(name).or_default().insert(version);
    }
    versions
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

/// The top-level modules of a crate form layers: none depends on itself through others.
#[test]
fn module_dependencies_have_no_cycles() {
    let crates = ALLOWED.iter().map(|(name, _)| root().join(name)).chain([root().to_owned()]);
    let mut cycles = Vec::new();
    for directory in crates.map(|path| path.join("src")) {
        let uses = module_uses(&directory);
        for module in uses.keys() {
            let mut path = vec![module.as_str()];
            if reaches(&uses, &mut path, module, &mut BTreeSet::new()) {
                cycles.push(format!("{}: {}", directory.display(), path.join(" -> ")));
            }
        }
    }
    assert!(cycles.is_empty(), "modules depend on each other:\n{}", cycles.join("\n"));
}

/// Extends `path` to one that ends in `target`, if the last module of `path` leads there.
fn reaches<'a>(
    uses: &'a BTreeMap<String, BTreeSet<String>>,
    path: &mut Vec<&'a str>,
    target: &str,
    seen: &mut BTreeSet<&'a str>,
) -> bool {
    let last = path.last().copied().unwrap_or_default();
    for next in uses.get(last).into_iter().flatten() {
        path.push(next);
        if next == target || (seen.insert(next) && reaches(uses, path, target, seen)) {
            return true;
        }
        path.pop();
    }
    false
}

/// The top-level modules that each top-level module of a crate names outside its unit tests.
fn module_uses(directory: &Path) -> BTreeMap<String, BTreeSet<String>> {
    let root_file = ["lib.rs", "main.rs"].map(|name| directory.join(name));
    let root_file = root_file.iter().find(|path| path.exists()).expect("a crate");
    let root_text = fs::read_to_string(root_file).expect("readable");
    let modules = modules_of(&root_text);
    let exports = exports_of(&root_text);
    let mut uses = BTreeMap::new();
    for module in &modules {
        let files = [directory.join(format!("{module}.rs")), directory.join(module)];
        let mut used = BTreeSet::new();
        let sources = files.iter().filter(|path| path.exists()).flat_map(|path| rust_files(path));
        for path in sources.filter(|path| !is_of_tests(path)) {
            let depth = path.strip_prefix(directory).expect("below").components().count();
            let program = code_of(&path);
            let from_root = "super::".repeat(depth);
            for prefix in ["crate::", from_root.as_str()] {
                used.extend(names_after(&program, prefix));
            }
        }
        let resolve = |name: String| match modules.contains(&name) {
            true => Some(name),
            false => exports.get(&name).cloned(),
        };
        let used = used.into_iter().filter_map(resolve).filter(|name| name != module).collect();
        uses.insert(module.clone(), used);
    }
    uses
}

/// Returns whether a file consists of unit tests.
fn is_of_tests(path: &Path) -> bool {
    let below = path.strip_prefix(root()).expect("below");
    below.iter().any(|part| part == "tests" || part == "tests.rs")
}

/// Returns the lines of a file that are neither comments nor unit tests.
fn code_of(path: &Path) -> String {
    let program = without_tests(&fs::read_to_string(path).expect("readable"));
    let is_code = |line: &&str| !line.trim_start().starts_with("//");
    program.lines().filter(is_code).collect::<Vec<_>>().join("\n")
}

/// Returns what precedes the unit tests of a file. They may also be declared at its top and lie in a file of their own.
fn without_tests(text: &str) -> String {
    let text = text.replace("#[cfg(test)]\nmod tests;\n", "");
    text.split("#[cfg(test)]").next().unwrap_or_default().to_owned()
}

/// The modules that the root of a crate declares, those for its unit tests left out.
fn modules_of(root: &str) -> BTreeSet<String> {
    let lines: Vec<&str> = root.lines().map(str::trim).collect();
    let is_test = |idx: usize| idx > 0 && lines[idx - 1] == "#[cfg(test)]";
    let declared = lines.iter().enumerate().filter(|(idx, _)| !is_test(*idx));
    let name = |line: &str| {
        let line = line.trim_start_matches("pub(crate) ").trim_start_matches("pub ");
        Some(line.strip_prefix("mod ")?.strip_suffix(';')?.to_owned())
    };
    declared.filter_map(|(_, line)| name(line)).collect()
}

/// The modules behind the names that the root of a crate re-exports.
fn exports_of(root: &str) -> BTreeMap<String, String> {
    let statements = root.split("pub use ").skip(1).filter_map(|rest| rest.split(';').next());
    let pairs = statements.flat_map(|statement| {
        let (module, names) = statement.split_once("::").unwrap_or((statement, ""));
        let names = names.split(|c: char| !c.is_alphanumeric() && c != '_');
        let names: Vec<_> = names.filter(|name| !name.is_empty()).collect();
        names.into_iter().map(move |name| (name.to_owned(), module.to_owned()))
    });
    pairs.collect()
}

/// The first names after `prefix`: one, or those in the braces of a `use`.
fn names_after(text: &str, prefix: &str) -> Vec<String> {
    let is_name = |c: char| c.is_alphanumeric() || c == '_';
    let first = |text: &str| text.chars().take_while(|c| is_name(*c)).collect::<String>();
    let starts = text.match_indices(prefix).map(|(at, _)| (at, &text[at + prefix.len()..]));
    let whole = starts.filter(|(at, _)| !text[..*at].ends_with(|c| is_name(c) || c == ':'));
    whole
        .flat_map(|(_, rest)| match rest.strip_prefix('{') {
            None => vec![first(rest)],
            Some(list) => in_braces(list).iter().map(|part| first(part.trim())).collect(),
        })
        .filter(|name| !name.is_empty())
        .collect()
}

/// The parts of a list up to its closing brace, split at the commas outside of inner braces.
fn in_braces(list: &str) -> Vec<&str> {
    let (mut parts, mut start, mut depth) = (Vec::new(), 0, 0_usize);
    for (at, c) in list.char_indices() {
        match c {
            '{' => depth += 1,
            '}' if depth > 0 => depth -= 1,
            ',' | '}' if depth == 0 => {
                parts.push(&list[start..at]);
                start = at + 1;
                if c == '}' {
                    break;
                }
            }
            _ => {}
        }
    }
    parts
}
