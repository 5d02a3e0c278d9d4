//! The built program in a workspace with secrets, certificates and a small run.

use std::fs::{self, File};
use std::io::{BufRead as _, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::Duration;

use rcgen::{BasicConstraints, CertificateParams, CertifiedIssuer, DnType, IsCa, KeyPair};
use tempfile::TempDir;

/// Content of the file `token`.
pub(crate) const SECRET: &str = "the-right-token-0123";
/// Limit of every wait, sufficient for busy machines.
pub(crate) const DEADLINE: Duration = Duration::from_secs(120);
const PAUSE: Duration = Duration::from_millis(50);

/// A run file with two rounds and small networks.
const RUN: &str = "
arms = 2
advice.strategy = \"mc-q:0.1\"
advice.budget = 3000
ddpg.n_hidden = 16
evaluation.episodes = 4
evaluation.every_env_steps = 800
stop.max_env_steps = 1600
";

/// A workspace directory with `token`, `ca.pem`, `tls.pem` with `tls.key`, another authority's `other.pem`, `other.key`
/// and `run.toml`.
pub(crate) struct Workspace(TempDir);

impl Workspace {
    pub(crate) fn new() -> Self {
        let workspace = Self(tempfile::tempdir().expect("a directory"));
        let (ours, theirs) = (authority("ours"), authority("theirs"));
        let mut params = CertificateParams::new(["127.0.0.1".to_owned()]).expect("a name");
        params.distinguished_name.push(DnType::CommonName, "tandem");
        let key = KeyPair::generate().expect("a key");
        let certificate = params.signed_by(&key, &ours).expect("signs");
        workspace.write("token", SECRET);
        workspace.write("ca.pem", &ours.pem());
        workspace.write("tls.pem", &certificate.pem());
        workspace.write("tls.key", &key.serialize_pem());
        workspace.write("other.pem", &theirs.pem());
        workspace.write("other.key", &theirs.key().serialize_pem());
        workspace.write("run.toml", RUN);
        workspace
    }

    pub(crate) fn path(&self) -> &Path {
        self.0.path()
    }

    pub(crate) fn write(&self, name: &str, text: &str) {
        fs::write(self.path().join(name), text).expect("writes");
    }

    /// Returns the command line of a learner with a new run directory.
    pub(crate) fn learner(&self, more: &[&str]) -> Vec<String> {
        let out = tempfile::tempdir_in(self.path()).expect("a directory").keep();
        let out = out.to_string_lossy();
        let args = [&["learner", "--run", "run.toml", "--out", &out][..], more].concat();
        args.into_iter().map(str::to_owned).collect()
    }

    fn command(&self, args: &[impl AsRef<str>]) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_tandem"));
        command.args(args.iter().map(AsRef::as_ref)).current_dir(self.path());
        command.env_remove("TANDEM_TOKEN_FILE").env_remove("RUST_LOG").stdin(Stdio::null());
        command
    }

    /// Runs a command and waits for its end.
    pub(crate) fn run(&self, args: &[impl AsRef<str>]) -> Output {
        self.command(args).output().expect("runs")
    }

    /// Starts a command whose log is named `name`.
    pub(crate) fn start(&self, name: &str, args: &[impl AsRef<str>]) -> Running {
        let log = self.path().join(format!("{name}.log"));
        let file = File::create(&log).expect("a log");
        let child = self.command(args).stdout(Stdio::piped()).stderr(file).spawn().expect("starts");
        Running { child, address: String::new(), log }
    }

    /// Starts a service and waits until it prints its address.
    pub(crate) fn serve(&self, name: &str, args: &[impl AsRef<str>]) -> Running {
        let mut running = self.start(name, args);
        let mut line = String::new();
        let mut output = BufReader::new(running.child.stdout.take().expect("piped"));
        output.read_line(&mut line).expect("a line");
        let address = line.trim().strip_prefix("listening on ").map(str::to_owned);
        assert!(address.is_some(), "{name}: {}", running.log());
        running.address = address.unwrap_or_default();
        running
    }
}

/// Returns the command line of a teacher.
pub(crate) fn teacher(more: &[&str]) -> Vec<String> {
    let policy = Path::new(env!("CARGO_MANIFEST_DIR")).join("policies/teacher-push.safetensors");
    let policy = policy.to_string_lossy();
    let args = [&["teacher", "--ledger", "memory", "--policy", &policy][..], more].concat();
    args.into_iter().map(str::to_owned).collect()
}

/// A process that is killed on drop.
pub(crate) struct Running {
    child: Child,
    /// The address of a service.
    pub(crate) address: String,
    log: PathBuf,
}

impl Running {
    /// Returns the address at which this machine reaches the service.
    pub(crate) fn local_address(&self) -> String {
        self.address.replace("0.0.0.0", "127.0.0.1")
    }

    /// Returns the standard error so far.
    pub(crate) fn log(&self) -> String {
        fs::read_to_string(&self.log).expect("readable")
    }

    pub(crate) fn is_alive(&mut self) -> bool {
        self.child.try_wait().expect("ours").is_none()
    }

    /// Sends SIGTERM, waits for the end and returns the exit code. The log is then complete.
    pub(crate) fn end(&mut self) -> Option<i32> {
        let asked = Command::new("kill").arg(self.child.id().to_string()).status();
        assert!(asked.expect("kill runs").success(), "{}", self.log());
        self.wait()
    }

    /// Waits for the end and returns the exit code.
    pub(crate) fn wait(&mut self) -> Option<i32> {
        self.child.wait().expect("ours").code()
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        drop(self.child.kill());
        drop(self.child.wait());
    }
}

fn authority(name: &str) -> CertifiedIssuer<'static, KeyPair> {
    let mut params = CertificateParams::new([]).expect("no names");
    params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
    params.distinguished_name.push(DnType::CommonName, name);
    let key = KeyPair::generate().expect("a key");
    CertifiedIssuer::self_signed(params, key).expect("a certificate")
}

/// Checks that a command ended with `code` and returns its error line, which follows its log lines.
pub(crate) fn fails_with(code: i32, output: Output) -> String {
    let stderr = String::from_utf8(output.stderr).expect("UTF-8");
    assert_eq!(output.status.code(), Some(code), "{stderr}");
    let lines: Vec<&str> = stderr.lines().filter(|line| line.starts_with("tandem: ")).collect();
    assert_eq!(lines.len(), 1, "{stderr}");
    assert_eq!(stderr.lines().last(), lines.first().copied(), "{stderr}");
    lines[0].to_owned()
}

/// Polls `holds` until it is true or [`DEADLINE`] has passed.
pub(crate) fn eventually(holds: impl Fn() -> bool) -> bool {
    (0..DEADLINE.as_millis() / PAUSE.as_millis()).any(|_| {
        let held = holds();
        if !held {
            std::thread::sleep(PAUSE);
        }
        held
    })
}
