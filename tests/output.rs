//! Standard output and standard error that cannot be written: a full disk, a file size limit, a reader that stopped
//! reading.

use std::fs::{self, File};
use std::io::{BufRead as _, BufReader, Write as _};
use std::path::Path;
use std::process::{Command, Output, Stdio};

use tempfile::TempDir;

const TANDEM: &str = env!("CARGO_BIN_EXE_tandem");
const POLICY: &str =
    concat!(env!("CARGO_MANIFEST_DIR"), "/policies/teacher-push-classic.safetensors");

/// A short run with one arm and no teacher.
const SHORT_RUN: &str = r#"
task = "push"
arms = 1
advice.strategy = "none"
rounds.slots = 2
ddpg = { n_hidden = 16, n_hidden_layers = 1, batch_size = 32 }
evaluation = { every_env_steps = 800, episodes = 4, test_episodes = 4 }
stop.max_env_steps = 1600
"#;

fn tandem(args: &[&str]) -> Command {
    let mut command = Command::new(TANDEM);
    command.args(args).stdin(Stdio::null()).current_dir(env!("CARGO_MANIFEST_DIR"));
    command.env_remove("RUST_LOG");
    command
}

/// Opens a file on a full disk.
fn full_device() -> File {
    File::options().write(true).open("/dev/full").expect("a device")
}

fn directory() -> TempDir {
    tempfile::tempdir().expect("a directory")
}

fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// Writes the run file and returns the command that trains it into the directory `name`.
fn train(directory: &Path, name: &str) -> Command {
    let run = directory.join("short.toml");
    fs::write(&run, SHORT_RUN).expect("writes");
    let mut command = tandem(&["train", "--json", "--workers", "1", "--run"]);
    command.arg(run).arg("--out").arg(directory.join(name));
    command
}

fn digest(output: &Output) -> String {
    assert!(output.status.success(), "{:?}: {}", output.status, stderr(output));
    let summary: serde_json::Value = serde_json::from_slice(&output.stdout).expect("a summary");
    summary["digest"].as_str().expect("a digest").to_owned()
}

#[test]
fn a_result_that_cannot_be_written_is_reported_in_one_line() {
    let directory = directory();
    let path = |name: &str| directory.path().join(name).to_str().expect("UTF-8").to_owned();
    let (episode, recovered, picture) =
        (path("one.mcap"), path("recovered.mcap"), path("arms.png"));
    let recorded =
        tandem(&["eval", "--policy", POLICY, "--episodes", "1", "--record", &episode]).output();
    assert!(recorded.expect("runs").status.success());
    for args in [
        &["--help"][..],
        &["--version"],
        &["train", "--help"],
        &["policy", "show", POLICY],
        &["policy", "show", POLICY, "--json"],
        &["eval", "--policy", POLICY, "--episodes", "1"],
        &["eval", "--policy", POLICY, "--episodes", "1", "--json"],
        &["eval", "--policy", POLICY, "--episodes", "1", "--robustness"],
        &["replay", &episode],
        &["replay", &episode, "--verify", "--json"],
        &["mcap", "recover", &episode, "--to", &recovered],
        &["picture", "--policy", POLICY, "--out", &picture],
        &["sweep", "deploy/sweep-small.toml", "--dry-run"],
    ] {
        let ended = tandem(args).stdout(full_device()).output().expect("runs");
        assert_eq!(ended.status.code(), Some(74), "{args:?}: {}", stderr(&ended));
        let expected =
            "tandem: cannot write to standard output: No space left on device (os error 28)\n";
        assert_eq!(stderr(&ended), expected, "{args:?}");
        fs::remove_file(&recovered).ok();
        let ended =
            tandem(args).stdout(full_device()).stderr(full_device()).status().expect("runs");
        assert_eq!(ended.code(), Some(74), "{args:?}");
    }
}

#[test]
fn an_error_keeps_its_exit_code_when_its_message_cannot_be_written() {
    for (args, code) in [(&["dance"][..], 64), (&["policy", "show", "missing"], 65)] {
        let ended =
            tandem(args).stdout(full_device()).stderr(full_device()).status().expect("runs");
        assert_eq!(ended.code(), Some(code), "{args:?}");
    }
}

#[test]
fn a_run_does_not_depend_on_room_for_its_messages_and_logs() {
    let directory = directory();
    let expected = digest(&train(directory.path(), "undisturbed").output().expect("runs"));
    let out = directory.path().join("mute");
    fs::create_dir(&out).expect("a directory");
    std::os::unix::fs::symlink("/dev/full", out.join("tandem.log")).expect("a link");
    let ended =
        train(directory.path(), "mute").stderr(full_device()).stdout(Stdio::piped()).output();
    assert_eq!(digest(&ended.expect("runs")), expected);
}

#[test]
fn a_run_does_not_wait_for_a_reader_of_its_messages() {
    let directory = directory();
    let (reader, mut writer) = std::io::pipe().expect("a pipe");
    rustix::io::ioctl_fionbio(&writer, true).expect("a pipe");
    while writer.write(&[b'x'; 512]).is_ok() {}
    rustix::io::ioctl_fionbio(&writer, false).expect("a pipe");
    let ended = train(directory.path(), "stuck").stderr(writer).stdout(Stdio::piped()).output();
    digest(&ended.expect("runs"));
    drop(reader);
}

#[test]
fn a_run_whose_summary_cannot_be_written_is_saved_and_reports_its_directory() {
    let directory = directory();
    let ended = train(directory.path(), "run").stdout(full_device()).output().expect("runs");
    let message = stderr(&ended);
    assert_eq!(ended.status.code(), Some(74), "{message}");
    let out = directory.path().join("run");
    let last = message.lines().last().expect("a line");
    let expected = format!("tandem: the run is complete and saved in {}", out.display());
    assert!(last.starts_with(&expected), "{message}");
    assert!(last.contains("cannot write to standard output"), "{message}");
    assert!(!message.contains("panicked"), "{message}");
    assert!(out.join("policy/best.safetensors").exists() && out.join("report.html").exists());
}

/// Returns the address in the first line that contains one.
fn address(lines: impl Iterator<Item = std::io::Result<String>>) -> String {
    let mut lines = lines.map(|line| line.expect("text"));
    let line = lines.find(|line| line.contains("127.0.0.1:")).expect("an address");
    let at = line.find("127.0.0.1:").expect("checked");
    line[at..].chars().take_while(|c| c.is_ascii_digit() || ".:".contains(*c)).collect()
}

#[test]
fn a_service_that_cannot_print_its_address_still_serves() {
    let mut command = tandem(&["teacher", "--ledger", "memory", "--policy", POLICY]);
    let mut teacher = command.stdout(full_device()).stderr(Stdio::piped()).spawn().expect("starts");
    let messages = BufReader::new(teacher.stderr.take().expect("piped"));
    let address = address(messages.lines());
    let health = tandem(&["health", &address]).output().expect("runs");
    teacher.kill().expect("runs");
    teacher.wait().expect("ends");
    assert!(health.status.success(), "{}", stderr(&health));
}

#[test]
fn a_service_that_cannot_write_its_log_still_serves() {
    let mut command = tandem(&["teacher", "--ledger", "memory", "--policy", POLICY]);
    let mut teacher = command.stdout(Stdio::piped()).stderr(full_device()).spawn().expect("starts");
    let output = BufReader::new(teacher.stdout.take().expect("piped"));
    let address = address(output.lines());
    let health = tandem(&["health", &address]).output().expect("runs");
    let sent = Command::new("kill").args(["-TERM", &teacher.id().to_string()]).status();
    assert!(sent.expect("kill runs").success());
    assert!(teacher.wait().expect("ends").success());
    assert!(health.status.success(), "{}", stderr(&health));
}

/// Runs a shell script with the program as `$0` and a policy as `$1`.
fn shell(script: &str) -> Output {
    let directory = directory();
    let mut command = Command::new("bash");
    command.args(["-c", script, TANDEM, POLICY]).current_dir(directory.path());
    command.output().expect("runs")
}

#[test]
fn a_file_size_limit_is_reported_like_a_full_disk() {
    let ended = shell(r#"ulimit -f 0; exec "$0" policy show "$1" > shown"#);
    assert_eq!(ended.status.code(), Some(74), "{:?}: {}", ended.status, stderr(&ended));
    assert!(stderr(&ended).contains("File too large"), "{}", stderr(&ended));
}

#[test]
fn a_command_succeeds_with_closed_standard_streams() {
    let ended = shell(r#"exec "$0" policy show "$1" >&- 2>&-"#);
    assert_eq!(ended.status.code(), Some(0), "{}", stderr(&ended));
}
