//! The arms' side in C (`bridge/quarc`) over a stand-in for Quanser's Stream API, against the driver.
//!
//! Time passes in the C program only when a test asks for samples, so that no result depends on the machine.

use std::cell::{Cell, RefCell};
use std::io::{BufRead as _, BufReader, ErrorKind, Read as _, Write as _};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, ChildStdout, Command as Process, Stdio};
use std::rc::Rc;
use std::sync::OnceLock;
use std::thread;
use std::time::Duration;

use tandem_bridge::quarc::codec::{
    COMMAND_LEN, STATE_BYTES, STATE_LEN, decode_state, encode_command, from_bytes, to_bytes,
};
use tandem_bridge::quarc::{QuarcConfig, QuarcDriver};
use tandem_bridge::{ArmCommand, Command, Order, PairState, Phase, Settings, StopCause};
use tandem_kinematics::Joints;

use crate::drivers::rig::{PERIOD_S, Patient, Rig, sweep};
use crate::skipped::skip;

const SOURCES: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/bridge/quarc");
const WARNINGS: [&str; 5] = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic"];
const SANITIZERS: [&str; 3] = [
    "-g",
    "-fsanitize=address,undefined,float-divide-by-zero,float-cast-overflow",
    "-fno-sanitize-recover=all",
];
const RATE_RADPS: f64 = 0.3;

/// Compiles a program. Returns `None` without a C compiler, unless one is required.
fn compiled(name: &str, files: &[&str], options: &[&str]) -> Option<PathBuf> {
    let program = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    // Two runs of the tests may compile at the same time.
    let own = program.with_extension(std::process::id().to_string());
    let mut cc = Process::new("cc");
    cc.current_dir(SOURCES).args(WARNINGS).args(options).args(["-I.", "-Istandin"]).args(files);
    let output = match cc.args(["-lm", "-o"]).arg(&own).output() {
        Ok(output) => output,
        Err(error) if error.kind() == ErrorKind::NotFound => {
            skip("CC", "the arms' side in C: there is no C compiler `cc`");
            return None;
        }
        Err(error) => panic!("{error}"),
    };
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    std::fs::rename(own, &program).unwrap();
    Some(program)
}

fn pair_program() -> Option<&'static PathBuf> {
    static PROGRAM: OnceLock<Option<PathBuf>> = OnceLock::new();
    let files =
        ["standin/simulated_pair.c", "standin/quanser_stream.c", "stream_side.c", "arm_side.c"];
    PROGRAM.get_or_init(|| compiled("quarc-pair", &files, &["-O1"])).as_ref()
}

/// The outcome of samples.
#[derive(Debug)]
struct Report {
    n_connected: u32,
    n_disconnected: u32,
    brakes: bool,
    commanded_radps: f64,
    fastest_radps: f64,
    angles: [Joints; 2],
    openings: [f64; 2],
}

/// Simulated arms in C, as a process.
struct Arms {
    process: Child,
    requests: ChildStdin,
    reports: BufReader<ChildStdout>,
    address: String,
}

impl Arms {
    /// Starts the program with more arguments. Returns `None` without a C compiler.
    fn start(args: &[String]) -> Option<Self> {
        let mut process = Process::new(pair_program()?)
            .args(["--uri", "tcpip://localhost:0?nagle='off'"])
            .args(args)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let requests = process.stdin.take().unwrap();
        let mut reports = BufReader::new(process.stdout.take().unwrap());
        let mut line = String::new();
        reports.read_line(&mut line).unwrap();
        let address = line.trim().strip_prefix("listening on ").unwrap().to_owned();
        Some(Self { process, requests, reports, address })
    }

    fn request(&mut self, line: &str) -> Report {
        writeln!(self.requests, "{line}").unwrap();
        let mut report = String::new();
        self.reports.read_line(&mut report).unwrap();
        let numbers: Vec<f64> =
            report.split_whitespace().map(|word| word.parse().unwrap()).collect();
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "small counts")]
        let [n_connected, n_disconnected] = [numbers[1] as u32, numbers[2] as u32];
        Report {
            n_connected,
            n_disconnected,
            brakes: numbers[3] == 1.0,
            commanded_radps: numbers[4],
            fastest_radps: numbers[5],
            angles: [Joints::new(&numbers[6..10]), Joints::new(&numbers[10..14])],
            openings: [numbers[14], numbers[15]],
        }
    }

    /// Passes samples of 10 ms.
    fn sample(&mut self, n: u32) -> Report {
        self.request(&format!("sample {n}"))
    }

    fn driver(&self) -> QuarcConfig {
        QuarcConfig { wait: Duration::ZERO, ..QuarcConfig::at(format!("tcpip://{}", self.address)) }
    }

    /// Connects, and passes the sample in which the connection is accepted.
    fn connect(&mut self) -> Client {
        let mut client = Client(TcpStream::connect(&self.address).unwrap());
        self.sample(1);
        client.state();
        client
    }
}

impl Drop for Arms {
    fn drop(&mut self) {
        drop(self.process.kill());
        drop(self.process.wait());
    }
}

/// A bridge that sends any vectors.
struct Client(TcpStream);

impl Client {
    fn send(&mut self, vector: &[f64; COMMAND_LEN]) {
        self.0.write_all(&to_bytes(vector)).unwrap();
        // The loopback interface of a busy machine may deliver later.
        thread::sleep(Duration::from_millis(1));
    }

    fn stop(&mut self, number: u64) {
        self.send(&encode_command(&Command { number, order: Order::Stop }, PERIOD_S).unwrap());
    }

    fn go(&mut self, number: u64) {
        self.send(&go(number));
    }

    /// Receives the next state as it is on the wire.
    fn vector(&mut self) -> [f64; STATE_LEN] {
        let mut bytes = [0; STATE_BYTES];
        self.0.set_read_timeout(Some(Duration::from_secs(60))).unwrap();
        self.0.read_exact(&mut bytes).unwrap();
        from_bytes(&bytes)
    }

    fn state(&mut self) -> PairState {
        decode_state(&self.vector()).unwrap()
    }

    /// Receives the states of `n` samples and returns the last one.
    fn nth_state(&mut self, n: u32) -> PairState {
        (0..n).map(|_| self.state()).last().unwrap()
    }
}

/// The command that moves all joints.
fn go(number: u64) -> [f64; COMMAND_LEN] {
    let arm = ArmCommand { velocities: Joints::from_fn(4, |_| RATE_RADPS), opening: 0.5 };
    encode_command(&Command { number, order: Order::Move(vec![arm; 2]) }, PERIOD_S).unwrap()
}

/// Arms that follow a bridge: commands 1 to 20 were sent.
fn moving(args: &[String]) -> Option<(Arms, Client)> {
    let mut arms = Arms::start(args)?;
    let mut client = arms.connect();
    client.stop(1);
    arms.sample(1);
    client.state();
    for number in 2..=20 {
        client.go(number);
        let report = arms.sample(1);
        assert!(!report.brakes && (report.commanded_radps - RATE_RADPS).abs() < 1e-9, "{report:?}");
        let state = client.state();
        assert_eq!((state.newest_command, state.arms[0].faults.drive), (Some(number), false));
        assert_eq!(state.sequence, number + 1);
    }
    assert!(arms.sample(0).fastest_radps > 0.9 * RATE_RADPS);
    Some((arms, client))
}

#[test]
fn the_c_code_follows_the_examples_and_withstands_random_numbers() {
    let files = ["check.c", "arm_side.c"];
    let Some(program) = compiled("quarc-check", &files, &SANITIZERS) else { return };
    for args in [["vectors", "vectors.txt"].as_slice(), &["hostile", "20261", "30000"]] {
        let output = Process::new(&program).args(args).current_dir(SOURCES).output().unwrap();
        let said = String::from_utf8_lossy(&output.stdout).into_owned();
        let errors = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.success() && !said.starts_with("0 "), "{said}{errors}");
    }
    // With these options a compiler may ignore numbers that are not finite.
    let fast = ["-ffast-math", "-fsyntax-only", "arm_side.c"];
    let output = Process::new("cc").args(fast).current_dir(SOURCES).output().unwrap();
    assert!(String::from_utf8_lossy(&output.stderr).contains("compile without -ffast-math"));
}

#[test]
fn a_motion_is_played_to_its_end_by_the_c_code() {
    let motion = sweep([0.5, 0.5, 0.3, 0.3]);
    let start = motion.arms.iter().flat_map(|samples| samples[0].angles.iter());
    let start: Vec<String> = start.map(ToString::to_string).collect();
    let Some(mut arms) = Arms::start(&start) else { return };
    let config = arms.driver();
    let connecting = thread::spawn(move || QuarcDriver::connect(config).unwrap());
    while arms.sample(1).n_connected == 0 {
        thread::sleep(Duration::from_millis(1));
    }
    let driver = connecting.join().unwrap();
    let arms = Rc::new(RefCell::new(arms));
    let (passing, waits) = (Rc::clone(&arms), Rc::new(Cell::new(true)));
    let pass = move || {
        passing.borrow_mut().sample(1);
    };
    let mut rig = Rig::new(Patient::new(driver, &waits, pass), Settings::default());
    rig.reset();
    rig.start(&motion);
    rig.play();
    let ended = arms.borrow_mut().sample(0);
    for (samples, angles) in motion.arms.iter().zip(&ended.angles) {
        let off_rad = samples[samples.len() - 1].angles.largest_difference(angles);
        assert!(off_rad < 0.3_f64.to_radians(), "{off_rad} rad from the end");
    }
    assert!(ended.openings.iter().all(|opening| (opening - 0.3).abs() < 0.02), "{ended:?}");

    // The executor notices that the arms have braked by themselves.
    waits.set(false);
    arms.borrow_mut().request("sensors off");
    assert!(matches!(rig.until_stopped(), StopCause::StateStale(_)));
    assert_eq!(rig.tick(), Phase::Stopped);
}

#[test]
fn silence_brakes_the_arms_after_50_ms() {
    let Some((mut arms, mut client)) = moving(&[]) else { return };
    // The sample that took command 20 and four more follow it: 50 ms.
    assert!(!arms.sample(4).brakes);
    assert!(!client.nth_state(4).arms[0].faults.drive);
    let braking = arms.sample(1);
    assert!(braking.brakes && braking.commanded_radps == 0.0, "{braking:?}");
    let state = client.state();
    assert!(state.arms.iter().all(|arm| arm.faults.drive));
    assert_eq!(state.newest_command, Some(20));
    let rested = arms.sample(5);
    assert!(rested.fastest_radps < 1e-3, "{rested:?}");
    // Only a stop ends that, and it may repeat the number.
    client.go(21);
    assert!(arms.sample(1).brakes);
    client.stop(20);
    assert!(arms.sample(1).brakes);
    assert!(!client.nth_state(7).arms[0].faults.drive);
    client.go(22);
    assert!(!arms.sample(1).brakes);
}

#[test]
fn a_bridge_that_ends_brakes_the_arms_at_once() {
    let Some((mut arms, client)) = moving(&[]) else { return };
    drop(client);
    thread::sleep(Duration::from_millis(1));
    let report = arms.sample(1);
    assert!(report.brakes && report.n_disconnected == 1, "{report:?}");
    assert!(arms.sample(5).fastest_radps < 1e-3);
    // The next connection starts with a stop and counts from 1.
    let mut client = arms.connect();
    client.go(21);
    let report = arms.sample(1);
    assert!(report.brakes && report.n_connected == 2, "{report:?}");
    let state = client.state();
    assert_eq!((state.sequence, state.newest_command), (2, Some(0)));
    assert!(state.arms[0].faults.drive);
}

#[test]
fn malformed_commands_and_failed_calls_of_the_arms_brake_them() {
    let Some((mut arms, mut client)) = moving(&[]) else { return };
    let mut number = 20;
    for (idx, value) in [(7, f64::NAN), (0, 20_002.0), (3, 3.0), (1, 0.5), (12, 1e308)] {
        number += 1;
        let mut vector = go(number);
        vector[idx] = value;
        client.send(&vector);
        let report = arms.sample(1);
        assert!(report.brakes && report.commanded_radps == 0.0, "{idx}: {report:?}");
        assert!(client.state().arms[1].faults.drive, "{idx}");
        client.stop(number);
        arms.sample(1);
        assert!(!client.state().arms[1].faults.drive);
        number += 1;
        client.go(number);
        assert!(!arms.sample(1).brakes);
        client.state();
    }
    arms.request("sensors off");
    assert!(arms.sample(2).brakes);
    arms.request("sensors on");
    arms.sample(1);
    // The numbers of the states have no gap, although two samples had no state.
    let state = client.state();
    assert!(state.arms[0].faults.drive);
    assert_eq!(state.sequence, 21 + 3 * 5 + 1);

    client.stop(number);
    arms.sample(1);
    arms.request("drives off");
    client.go(number + 1);
    arms.sample(1);
    arms.request("drives on");
    assert!(!client.state().arms[0].faults.drive && client.state().arms[0].faults.drive);
    client.go(number + 2);
    assert!(arms.sample(1).brakes);
}

#[test]
fn states_that_would_block_are_dropped_and_leave_no_gap() {
    let small = ["--send-bytes".to_owned(), "4608".to_owned()];
    let Some(mut arms) = Arms::start(&small) else { return };
    let mut client = arms.connect();
    // A reader that hangs for 30 s. It sends no commands, so the connection remains.
    assert_eq!(arms.sample(3000).n_disconnected, 0);
    let (mut n_states, mut dropped_s, mut before) = (1, 0.0, [0.0; STATE_LEN]);
    (before[1], before[2]) = (1.0, 0.0);
    while before[2] < 30.0 {
        let state = client.vector();
        assert_eq!(state[1], before[1] + 1.0, "a gap in the sequence");
        dropped_s += (state[2] - before[2] - PERIOD_S).max(0.0);
        (before, n_states) = (state, n_states + 1);
        if n_states % 16 == 0 {
            // The stream takes states again.
            arms.sample(1);
        }
    }
    assert!(dropped_s > 10.0, "{n_states} states, {dropped_s} s dropped");

    drop(client);
    thread::sleep(Duration::from_millis(1));
    arms.sample(1);
    let config = arms.driver();
    let connecting = thread::spawn(move || QuarcDriver::connect(config).unwrap());
    while arms.sample(1).n_connected < 2 {
        thread::sleep(Duration::from_millis(1));
    }
    let mut driver = connecting.join().unwrap();
    arms.sample(3000);
    let mut at_s = 0.0;
    while at_s < 60.0 {
        // An error would end the test: the driver accepts the states that are left.
        at_s = driver.listen(Duration::from_millis(1)).unwrap().stamp_s;
        arms.sample(1);
    }
}

#[test]
fn a_second_bridge_waits_until_the_first_has_gone() {
    let Some((mut arms, mut client)) = moving(&[]) else { return };
    let mut second = Client(TcpStream::connect(&arms.address).unwrap());
    second.stop(1);
    for number in 21..30 {
        client.go(number);
        assert!(!arms.sample(1).brakes);
        client.state();
    }
    second.0.set_nonblocking(true).unwrap();
    assert_eq!(second.0.read(&mut [0]).unwrap_err().kind(), ErrorKind::WouldBlock);
    second.0.set_nonblocking(false).unwrap();
    drop(client);
    thread::sleep(Duration::from_millis(1));
    // One sample ends the first connection, the next one accepts the second.
    assert_eq!(arms.sample(1).n_connected, 1);
    assert_eq!(arms.sample(1).n_connected, 2);
    let state = second.state();
    assert_eq!((state.sequence, state.newest_command), (1, Some(1)));
}

#[test]
fn a_connection_without_commands_is_closed_once_it_has_sent_some() {
    let Some(mut arms) = Arms::start(&[]) else { return };
    let mut client = arms.connect();
    // A program that only listens stays.
    assert_eq!(arms.sample(150).n_disconnected, 0);
    client.stop(1);
    assert_eq!(arms.sample(100).n_disconnected, 0);
    assert_eq!(arms.sample(1).n_disconnected, 1);
    let mut rest = Vec::new();
    client.0.read_to_end(&mut rest).unwrap();
    assert_eq!(rest.len(), 250 * STATE_BYTES);
}
