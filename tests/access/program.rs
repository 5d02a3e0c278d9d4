//! The built program in a directory with secrets, certificates and a small run.

use std::fs::{self, File};
use std::io::{BufRead as _, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::Duration;

use rcgen::{BasicConstraints, CertificateParams, CertifiedIssuer, DnType, IsCa, KeyPair};
use tempfile::TempDir;

/// What the file `token` holds.
pub(crate) const SECRET: &str = "the-right-token-0123";
/// Longer than anything takes, even on a machine that is busy with other things.
pub(crate) const DEADLINE: Duration = Duration::from_secs(120);
const PAUSE: Duration = Duration::from_millis(50);

/// Two rounds with small networks.
const RUN: &str = "
arms = 2
advice.strategy = \"mc-q:0.1\"
advice.budget = 3000
ddpg.n_hidden = 16
evaluation.episodes = 4
evaluation.every_env_steps = 800
stop.max_env_steps = 1600
";

/// A directory with `token`, `ca.pem`, `tls.pem` with `tls.key`, another authority's `other.pem`, `other.key` and
/// `run.toml`.
pub(crate) struct Place(TempDir);

impl Place {
    pub(crate) fn new() -> Self {
        let place = Self(tempfile::tempdir().expect("a directory"));
        let (ours, theirs) = (authority("ours"), authority("theirs"));
        let mut params = CertificateParams::new(["127.0.0.1".to_owned()]).expect("a name");
        params.distinguished_name.push(DnType::CommonName, "tandem");
        let key = KeyPair::generate().expect("a key");
        let certificate = params.signed_by(&key, &ours).expect("signs");
        place.write("token", SECRET);
        place.write("ca.pem", &ours.pem());
        place.write("tls.pem", &certificate.pem());
        place.write("tls.key", &key.serialize_pem());
        place.write("other.pem", &theirs.pem());
        place.write("other.key", &theirs.key().serialize_pem());
        place.write("run.toml", RUN);
        place
    }

    pub(crate) fn path(&self) -> &Path {
        self.0.path()
    }

    pub(crate) fn write(&self, name: &str, text: &str) {
        fs::write(self.path().join(name), text).expect("writes");
    }

    /// The command line of a learner with a run directory of its own.
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

    /// Runs a command to its end.
    pub(crate) fn run(&self, args: &[impl AsRef<str>]) -> Output {
        self.command(args).output().expect("runs")
    }

    /// Starts a command; `name` is for its log.
    pub(crate) fn start(&self, name: &str, args: &[impl AsRef<str>]) -> Running {
        let log = self.path().join(format!("{name}.log"));
        let file = File::create(&log).expect("a log");
        let child = self.command(args).stdout(Stdio::piped()).stderr(file).spawn().expect("starts");
        Running { child, address: String::new(), log }
    }

    /// Starts a service and waits until it says where it listens.
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

/// The command line of a teacher.
pub(crate) fn teacher(more: &[&str]) -> Vec<String> {
    let policy = Path::new(env!("CARGO_MANIFEST_DIR")).join("policies/teacher-push.safetensors");
    let policy = policy.to_string_lossy();
    let args = [&["teacher", "--ledger", "memory", "--policy", &policy][..], more].concat();
    args.into_iter().map(str::to_owned).collect()
}

/// A process that is killed when the test is through with it.
pub(crate) struct Running {
    child: Child,
    /// Where a service listens.
    pub(crate) address: String,
    log: PathBuf,
}

impl Running {
    /// The address by which this machine reaches it.
    pub(crate) fn local_address(&self) -> String {
        self.address.replace("0.0.0.0", "127.0.0.1")
    }

    /// What it has said on standard error.
    pub(crate) fn log(&self) -> String {
        fs::read_to_string(&self.log).expect("readable")
    }

    pub(crate) fn is_alive(&mut self) -> bool {
        self.child.try_wait().expect("ours").is_none()
    }

    /// Asks the process to end and waits until it has: its log is then complete. Returns the exit code.
    pub(crate) fn end(&mut self) -> Option<i32> {
        let asked = Command::new("kill").arg(self.child.id().to_string()).status();
        assert!(asked.expect("kill runs").success(), "{}", self.log());
        self.wait()
    }

    /// Waits for the end; gives the exit code.
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

/// The line in which a command that ended with `code` said what is wrong, after its log lines.
pub(crate) fn fails_with(code: i32, output: Output) -> String {
    let told = String::from_utf8(output.stderr).expect("UTF-8");
    assert_eq!(output.status.code(), Some(code), "{told}");
    let lines: Vec<&str> = told.lines().filter(|line| line.starts_with("tandem: ")).collect();
    assert_eq!(lines.len(), 1, "{told}");
    assert_eq!(told.lines().last(), lines.first().copied(), "{told}");
    lines[0].to_owned()
}

/// Looks again and again for as long as anything may take whether something has come true.
pub(crate) fn eventually(holds: impl Fn() -> bool) -> bool {
    (0..DEADLINE.as_millis() / PAUSE.as_millis()).any(|_| {
        let held = holds();
        if !held {
            std::thread::sleep(PAUSE);
        }
        held
    })
}
