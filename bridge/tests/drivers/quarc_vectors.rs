//! The examples of `bridge/quarc/vectors.txt`, which describes their format, with the arms' side in Rust.

use tandem_bridge::quarc::arm_side::ArmSide;
use tandem_bridge::quarc::codec::{COMMAND_LEN, COMMAND_MARK, STATE_LEN};
use tandem_bridge::{ArmReading, Command, Faults, Order, PairState};
use tandem_kinematics::Joints;

use crate::drivers::rig::PERIOD_S;

const VECTORS: &str = include_str!("../../quarc/vectors.txt");
/// Numbers of an arm in a line `reading`.
const READING_LEN: usize = 17;

/// The arms of a case and the outcome of the last sample.
struct Example {
    side: ArmSide,
    readings: Vec<f64>,
    changes: Vec<(usize, f64)>,
    is_connected: bool,
    is_blocked: bool,
    drives: Command,
    state: Option<[f64; STATE_LEN]>,
}

impl Example {
    fn new() -> Self {
        Self {
            side: ArmSide::new(PERIOD_S),
            readings: vec![0.0; 2 * READING_LEN],
            changes: Vec::new(),
            is_connected: false,
            is_blocked: false,
            drives: Command { number: 0, order: Order::Stop },
            state: None,
        }
    }

    fn send(&mut self, mut vector: [f64; COMMAND_LEN]) {
        for (idx, value) in &self.changes {
            vector[*idx] = *value;
        }
        // The outcome is visible in the states.
        drop(self.side.receive(&vector));
    }

    fn send_short(&mut self, number: f64, order: f64, rate_radps: f64) {
        let mut vector = [0.0; COMMAND_LEN];
        vector[..4].copy_from_slice(&[COMMAND_MARK, number, number * PERIOD_S, order]);
        if order == 1.0 {
            for arm in vector[4..].as_chunks_mut::<5>().0 {
                *arm = [rate_radps, rate_radps, rate_radps, rate_radps, 0.5];
            }
        }
        self.send(vector);
    }

    fn pass_sample(&mut self) {
        let is_measured = self.readings.iter().all(|number| number.is_finite());
        self.drives = self.side.sample(is_measured);
        self.state = None;
        if self.is_connected && is_measured {
            let arms = self.readings.chunks(READING_LEN).map(reading).collect();
            let measured = PairState { sequence: 0, stamp_s: 0.0, newest_command: None, arms };
            self.state = Some(self.side.encode(measured).unwrap());
            if !self.is_blocked {
                self.side.sent();
            }
        }
    }

    /// The velocities of each arm and its opening, or `None` where the drives brake.
    fn driven(&self) -> Option<Vec<f64>> {
        let Order::Move(arms) = &self.drives.order else { return None };
        let numbers =
            arms.iter().flat_map(|arm| arm.velocities.iter().copied().chain([arm.opening]));
        Some(numbers.collect())
    }

    fn sample(&mut self, words: &[&str], at: &str) {
        let [n, drives, fault, newest, sequence] = words else { panic!("{at}: malformed") };
        for _ in 0..n.parse::<usize>().unwrap() {
            self.pass_sample();
            let driven = self.driven();
            assert_eq!(driven.is_none(), *drives == "brake", "{at}: {driven:?}");
            if let (Some(driven), Some((_, rate))) = (driven, drives.split_once(':')) {
                let rate_radps: f64 = rate.parse().unwrap();
                let expected = [rate_radps, rate_radps, rate_radps, rate_radps, 0.5].repeat(2);
                assert_eq!(driven, expected, "{at}");
            }
            if let Some(state) = self.state {
                assert_eq!(
                    (state[18] == 1.0, state[3]),
                    (*fault == "fault", number(newest)),
                    "{at}"
                );
            }
        }
        let expected = (*sequence != "none").then(|| number(sequence));
        assert_eq!(self.state.map(|state| state[1]), expected, "{at}");
    }

    fn line(&mut self, word: &str, words: &[&str], at: &str) {
        let numbers = || words.iter().map(|word| number(word)).collect::<Vec<f64>>();
        match word {
            "case" => *self = Self::new(),
            "connect" | "disconnect" => {
                self.is_connected = word == "connect";
                self.side.set_connected(self.is_connected);
            }
            "stop" => self.send_short(numbers()[0], 0.0, 0.0),
            "move" => self.send_short(numbers()[0], 1.0, numbers()[1]),
            "change" => self.changes.push((words[0].parse().unwrap(), numbers()[1])),
            "same" => self.changes.clear(),
            "vector" => self.send(numbers().try_into().unwrap()),
            "reading" => self.readings = numbers(),
            "blocked" | "free" => self.is_blocked = word == "blocked",
            "sample" => self.sample(words, at),
            "drives" => assert_eq!(self.driven(), Some(numbers()), "{at}"),
            "state" => assert_eq!(self.state.unwrap().to_vec(), numbers(), "{at}"),
            _ => panic!("{at}: an unknown word"),
        }
    }
}

fn number(word: &str) -> f64 {
    word.parse().unwrap()
}

fn reading(numbers: &[f64]) -> ArmReading {
    let joints = |nth: usize| Joints::new(&numbers[4 * nth..4 * nth + 4]);
    ArmReading {
        angles: joints(0),
        velocities: joints(1),
        torques_nm: (numbers[13] != 0.0).then(|| joints(2)),
        opening: numbers[12],
        faults: Faults {
            drive: numbers[14] != 0.0,
            contact: numbers[15] != 0.0,
            emergency_stop: numbers[16] != 0.0,
        },
    }
}

#[test]
fn the_arms_side_follows_the_examples() {
    let (mut example, mut n_cases, mut case) = (Example::new(), 0, "");
    for (idx, line) in VECTORS.lines().enumerate() {
        let words: Vec<&str> = line.split_whitespace().collect();
        let Some((word, rest)) = words.split_first() else { continue };
        if word.starts_with('#') {
            continue;
        }
        if *word == "case" {
            (n_cases, case) = (n_cases + 1, line);
        }
        example.line(word, rest, &format!("line {}, {case}", idx + 1));
    }
    assert!(n_cases >= 19, "{n_cases} cases");
}
