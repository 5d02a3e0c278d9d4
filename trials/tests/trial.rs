//! Trials with policies that ship.
#![expect(clippy::unwrap_used, reason = "a test panics where it fails")]

use std::path::{Path, PathBuf};

use tandem_core::{Contacts, Layout, Task};
use tandem_policy::{Actor, Policy};
use tandem_trials::SimulatedConfig;
use tandem_trials::simulated::Block;
use tandem_trials::trial::{Look, Mode, NoWitness, TrialConfig, TrialReport, Trials, Witness};

fn shipped(name: &str) -> Actor {
    let path: PathBuf = [env!("CARGO_MANIFEST_DIR"), "..", "policies", name].iter().collect();
    Policy::load(Path::new(&path)).unwrap().actor().unwrap()
}

fn trials(task: Task, mode: Mode, seed: u64) -> Trials {
    let config = TrialConfig {
        layout: Layout::new(task, 2),
        mode,
        block: Block::small([0.0; 2]),
        seed,
        speed: 1.0,
        simulated: SimulatedConfig::default(),
        time_limit_s: 120.0,
    };
    Trials::new(config).unwrap()
}

fn run(trials: &mut Trials, number: u64, actor: &mut Actor) -> TrialReport {
    let mut decide = |observation: &[f32], goal: &[f32], action: &mut [f32]| {
        actor.act(observation, goal, action);
    };
    trials.run(number, &mut decide, &mut NoWitness).unwrap()
}

#[test]
fn a_policy_that_looks_pushes_both_blocks_to_their_goals() {
    let mut actor = shipped("student-push.safetensors");
    let mut trials = trials(Task::Push, Mode::ClosedLoop, 2);
    for number in 0..6 {
        let report = run(&mut trials, number, &mut actor);
        assert_eq!(report.cause, None, "trial {number}");
        assert_eq!(report.touched, Contacts::NONE);
        assert!(report.arms_gap_m > 0.0 && report.table_gap_m > 0.0);
        for object in &report.objects {
            assert!(object.goal_distance_m() <= 0.05);
            assert!((object.start - object.goal).length() >= 0.05, "nothing to do");
        }
    }
}

#[test]
fn a_trial_is_the_same_whatever_was_tried_before() {
    let mut actor = shipped("student-push.safetensors");
    let alone = run(&mut trials(Task::Push, Mode::ClosedLoop, 2), 2, &mut actor);
    let mut after_others = trials(Task::Push, Mode::ClosedLoop, 2);
    run(&mut after_others, 0, &mut actor);
    assert_eq!(run(&mut after_others, 2, &mut actor), alone);
    let open = run(&mut trials(Task::Push, Mode::OpenLoop, 2), 2, &mut actor);
    let start = |report: &TrialReport| report.objects.iter().map(|o| o.start).collect::<Vec<_>>();
    assert_eq!(start(&open), start(&alone), "both modes have the same starts");
}

/// Counts looks and sees to it that time goes on.
#[derive(Default)]
struct Watching {
    times_s: Vec<f64>,
    planned: usize,
}

impl Witness for Watching {
    fn look(&mut self, look: &Look<'_>) {
        assert_eq!((look.scene.arms.len(), look.scene.objects.len()), (2, 2));
        assert_eq!(look.scene.goals.len(), 2);
        self.times_s.push(look.time_s);
        self.planned += usize::from(look.planned.is_some());
    }
}

#[test]
fn a_policy_that_does_nothing_reaches_nothing_and_is_watched() {
    for mode in [Mode::OpenLoop, Mode::ClosedLoop] {
        let mut idle = |_: &[f32], _: &[f32], action: &mut [f32]| action.fill(0.0);
        let mut watching = Watching::default();
        let mut trials = trials(Task::PickAndPlace, mode, 1);
        let report = trials.run(0, &mut idle, &mut watching).unwrap();
        assert_eq!(report.cause.map(|cause| cause.name()), Some("not-reached"), "{mode:?}");
        assert_eq!(watching.times_s.len(), report.path.len());
        assert!(watching.times_s.is_sorted() && !watching.times_s.is_empty());
        for object in &report.objects {
            assert!((object.end - object.start).length() < 1e-3, "nobody touched it");
        }
    }
}
