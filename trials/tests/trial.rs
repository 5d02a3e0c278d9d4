//! Trials with the shipped policies.
#![expect(clippy::unwrap_used, reason = "a test panics where it fails")]

use std::path::{Path, PathBuf};

use glam::DVec3;
use tandem_core::layout::EPISODE_STEPS;
use tandem_core::{Contacts, Layout, Task};
use tandem_policy::{Actor, Policy};
use tandem_trials::SimulatedConfig;
use tandem_trials::simulated::Block;
use tandem_trials::trial::mapping::TRAINED_HALF_M;
use tandem_trials::trial::{
    Frame, NoObserver, ObjectPositions, Rehearsal, TrialConfig, TrialMode, TrialObserver,
    TrialReport, TrialRunner,
};

fn shipped(name: &str) -> Actor {
    let path: PathBuf = [env!("CARGO_MANIFEST_DIR"), "..", "policies", name].iter().collect();
    Policy::load(Path::new(&path)).unwrap().actor().unwrap()
}

fn trials(task: Task, mode: TrialMode, seed: u64) -> TrialRunner {
    TrialRunner::new(config(task, mode, seed)).unwrap()
}

fn config(task: Task, mode: TrialMode, seed: u64) -> TrialConfig {
    TrialConfig {
        layout: Layout::new(task, 2),
        mode,
        block: Block::small([0.0; 2]),
        trained_half_m: TRAINED_HALF_M,
        n_rehearsals: 32,
        seed,
        speed: 1.0,
        simulated: SimulatedConfig::default(),
        time_limit_s: 120.0,
    }
}

fn run(trials: &mut TrialRunner, number: u64, actor: &mut Actor) -> TrialReport {
    let mut act = |observation: &[f32], goal: &[f32], action: &mut [f32]| {
        actor.act(observation, goal, action);
    };
    trials.run(number, &mut act, &mut NoObserver).unwrap()
}

#[test]
fn a_closed_loop_pushes_both_blocks_to_their_goals() {
    let mut actor = shipped("student-push-classic.safetensors");
    let mut trials = trials(Task::Push, TrialMode::ClosedLoop, 2);
    for number in 0..6 {
        let report = run(&mut trials, number, &mut actor);
        assert_eq!(report.cause, None, "trial {number}");
        assert_eq!(report.touched, Contacts::NONE);
        assert!(report.arms_gap_m > 0.0 && report.table_gap_m > 0.0);
        for object in &report.objects {
            assert!(object.goal_distance_m() <= 0.05);
            assert!((object.start - object.goal).length() >= 0.05, "the start is not the goal");
        }
    }
}

#[test]
fn a_hand_that_would_press_on_its_block_continues() {
    let mut actor = shipped("student-push-classic.safetensors");
    let report = run(&mut trials(Task::Push, TrialMode::ClosedLoop, 1), 0, &mut actor);
    assert_eq!(
        report.cause, None,
        "arm 0 exceeds 4 N m unless it yields or keeps its lower pad above the block"
    );
}

/// Returns the smallest horizontal distance of `point` from 100 points of the line from `from` to `to`, metres.
fn distance_to_line_m(point: DVec3, from: DVec3, to: DVec3) -> f64 {
    let part = |step: u32| from.lerp(to, f64::from(step) / 100.0) - point;
    (0..=100).map(|step| part(step).truncate().length()).fold(f64::INFINITY, f64::min)
}

#[test]
fn one_arm_waits_where_pushed_objects_could_meet() {
    let mut trials = TrialRunner::new(TrialConfig {
        // Shorter than an episode, after which all arms withdraw.
        time_limit_s: 2.0,
        ..config(Task::SharedPush, TrialMode::ClosedLoop, 1)
    })
    .unwrap();
    let mut idle = |_: &[f32], _: &[f32], action: &mut [f32]| action.fill(0.0);
    let mut n_waiting = 0;
    for number in 0..12 {
        let report = trials.run(number, &mut idle, &mut NoObserver).unwrap();
        let room_m = |first: usize| {
            let (one, other) = (&report.positions[first], &report.positions[1 - first]);
            distance_to_line_m(other.start, one.start, one.goal).min(distance_to_line_m(
                one.goal,
                other.start,
                other.goal,
            ))
        };
        let moved = |arm: usize| {
            let ends = [&report.path[0], &report.path[report.path.len() - 1]];
            let [start, end] = ends.map(|point| point.measured[arm]);
            (end - start).length() > 0.05
        };
        let (one_m, other_m) = (room_m(0), room_m(1));
        let could_meet = one_m.min(other_m) < 0.10;
        // The order with more room is taken: the arm that goes first stays where it is, because its policy is idle.
        let expected = [could_meet && one_m < other_m, could_meet && one_m >= other_m];
        assert_eq!([moved(0), moved(1)], expected, "trial {number}: {one_m} {other_m}");
        n_waiting += usize::from(could_meet);
    }
    assert!((1..12).contains(&n_waiting), "{n_waiting} of 12 trials need an order");
}

/// Returns the shipped student of push, which does nothing in its first `n_episodes` episodes.
fn idle_at_first(n_episodes: usize) -> impl FnMut(&[f32], &[f32], &mut [f32]) {
    let mut actor = shipped("student-push-classic.safetensors");
    let mut n_actions = 0;
    move |observation: &[f32], goal: &[f32], action: &mut [f32]| {
        n_actions += 1;
        if n_actions <= n_episodes * EPISODE_STEPS {
            action.fill(0.0);
        } else {
            actor.act(observation, goal, action);
        }
    }
}

#[test]
fn a_policy_that_fails_plays_another_episode() {
    let mut trials = trials(Task::Push, TrialMode::ClosedLoop, 2);
    let report = trials.run(0, &mut idle_at_first(1), &mut NoObserver).unwrap();
    assert_eq!(report.cause, None);
    assert!(report.n_steps > EPISODE_STEPS, "{}", report.n_steps);
}

#[test]
fn a_trial_does_not_depend_on_the_trials_before_it() {
    let mut actor = shipped("student-push-classic.safetensors");
    let alone = run(&mut trials(Task::Push, TrialMode::ClosedLoop, 2), 2, &mut actor);
    let mut after_others = trials(Task::Push, TrialMode::ClosedLoop, 2);
    run(&mut after_others, 0, &mut actor);
    assert_eq!(run(&mut after_others, 2, &mut actor), alone);
    let open = run(&mut trials(Task::Push, TrialMode::OpenLoop, 2), 2, &mut actor);
    let start = |report: &TrialReport| report.objects.iter().map(|o| o.start).collect::<Vec<_>>();
    assert_eq!(start(&open), start(&alone), "both modes have the same starts");
}

/// Collects the positions of the tools and the heights of the shared object's parts.
#[derive(Default)]
struct Carrying {
    n_parts: Vec<usize>,
    /// For each frame in which both parts are above the table, the distance between the tools, metres.
    apart_m: Vec<f64>,
}

impl TrialObserver for Carrying {
    fn on_frame(&mut self, frame: &Frame<'_>) {
        self.n_parts.push(frame.scene.objects.len());
        if frame.scene.objects[..2].iter().all(|part| part.centre[2] > 0.04) {
            let tools = &frame.tools.measured;
            self.apart_m.push(tools[0].distance(tools[1]));
        }
    }
}

#[test]
fn two_arms_carry_one_object_together() {
    let mut actor = shipped("teacher-pick-and-place-classic.safetensors");
    let mut trials = trials(Task::CarryBar, TrialMode::ClosedLoop, 1);
    for number in 0..3 {
        let mut carrying = Carrying::default();
        let mut act = |observation: &[f32], goal: &[f32], action: &mut [f32]| {
            actor.act(observation, goal, action);
        };
        let report = trials.run(number, &mut act, &mut carrying).unwrap();
        assert_eq!(report.cause, None, "trial {number}");
        assert_eq!(report.touched, Contacts::NONE);
        assert!(report.arms_gap_m > 0.0 && report.table_gap_m > 0.0);
        let apart_m = |point: fn(&ObjectPositions) -> DVec3| {
            point(&report.positions[0]).distance(point(&report.positions[1]))
        };
        assert!((apart_m(|object| object.start) - 0.32).abs() < 1e-3);
        assert!((apart_m(|object| object.end) - 0.32).abs() < 1e-3, "one rigid body");
        assert!(report.objects.iter().all(|object| object.highest_m > 0.09), "it was lifted");
        assert!(carrying.n_parts.iter().all(|n| *n == 5), "handles, their rests, the plate");
        let [least, most] = carrying
            .apart_m
            .iter()
            .fold([f64::INFINITY, 0.0], |[least, most]: [f64; 2], m| [least.min(*m), most.max(*m)]);
        assert!(carrying.apart_m.len() > 20 && most - least < 0.02, "{least} to {most}");
    }
}

/// Counts frames and collects their times.
#[derive(Default)]
struct Watching {
    times_s: Vec<f64>,
    planned: usize,
}

impl TrialObserver for Watching {
    fn on_frame(&mut self, frame: &Frame<'_>) {
        assert_eq!((frame.scene.arms.len(), frame.scene.objects.len()), (2, 2));
        assert_eq!(frame.scene.goals.len(), 2);
        self.times_s.push(frame.time_s);
        self.planned += usize::from(frame.planned.is_some());
    }
}

#[test]
fn an_idle_policy_does_not_reach_its_goals_and_is_observed() {
    for (mode, cause) in
        [(TrialMode::OpenLoop, "not-reached"), (TrialMode::ClosedLoop, "timed-out")]
    {
        let mut idle = |_: &[f32], _: &[f32], action: &mut [f32]| action.fill(0.0);
        let mut watching = Watching::default();
        let config = TrialConfig {
            time_limit_s: 20.0,
            n_rehearsals: 2,
            ..config(Task::PickAndPlace, mode, 1)
        };
        let mut trials = TrialRunner::new(config).unwrap();
        let report = trials.run(0, &mut idle, &mut watching).unwrap();
        assert_eq!(report.cause.map(|cause| cause.name()), Some(cause), "{mode:?}");
        assert_eq!(watching.times_s.len(), report.path.len());
        assert!(watching.times_s.is_sorted() && !watching.times_s.is_empty());
        for object in &report.objects {
            assert!((object.end - object.start).length() < 1e-3, "no contact moved it");
        }
    }
}

#[test]
fn a_blind_motion_is_the_best_of_several_rehearsals() {
    let mut trials = trials(Task::Push, TrialMode::OpenLoop, 1);
    let report = trials.run(0, &mut idle_at_first(1), &mut NoObserver).unwrap();
    let rehearsed_m = report.rehearsed_m.unwrap();
    assert!(rehearsed_m.iter().all(|distance_m| *distance_m < 0.04), "{rehearsed_m:?}");
}

#[test]
fn a_blind_motion_is_also_rehearsed_in_the_closed_loop_on_copies_of_the_pair() {
    let n_rehearsals = 4;
    let config = TrialConfig { n_rehearsals, ..config(Task::Push, TrialMode::OpenLoop, 1) };
    let mut trials = TrialRunner::new(config).unwrap();
    let mut policy = idle_at_first(n_rehearsals as usize);
    let report = trials.run(0, &mut policy, &mut NoObserver).unwrap();
    assert_eq!(report.cause, None, "no motion of the training world reaches the goals");
}

#[test]
fn arms_reach_every_start_of_the_shared_world() {
    for task in Task::SHARED {
        let config = TrialConfig { time_limit_s: 0.3, ..config(task, TrialMode::ClosedLoop, 3) };
        let mut trials = TrialRunner::new(config).unwrap();
        let mut idle = |_: &[f32], _: &[f32], action: &mut [f32]| action.fill(0.0);
        for number in 0..100 {
            let report = trials.run(number, &mut idle, &mut NoObserver).unwrap();
            let cause = report.cause.map(|cause| cause.name());
            assert_eq!(cause, Some("timed-out"), "{task}, trial {number}");
        }
    }
}

#[test]
fn a_policy_perceives_the_rotation_and_the_size_that_it_was_trained_with() {
    let block = Block::small([0.0; 2]);
    let half_m = f64::from(block.half_m);
    for (trained_half_m, expected_m) in [(TRAINED_HALF_M, TRAINED_HALF_M), (half_m, half_m)] {
        let config = TrialConfig {
            trained_half_m,
            block,
            time_limit_s: 0.3,
            ..config(Task::SharedPush, TrialMode::ClosedLoop, 1)
        };
        let start = Rehearsal::new(config.layout, &block, trained_half_m)
            .unwrap()
            .start(config.seed, 0, |_| true)
            .unwrap();
        assert!(start.yaws_rad.iter().all(|yaw_rad| (0.01..0.79).contains(&yaw_rad.abs())));
        let mut seen = Vec::new();
        let mut look = |observation: &[f32], goal: &[f32], action: &mut [f32]| {
            seen.push((observation.to_vec(), goal.to_vec()));
            action.fill(0.0);
        };
        TrialRunner::new(config).unwrap().run(0, &mut look, &mut NoObserver).unwrap();
        let (observation, goal) = &seen[0];
        for arm in 0..2 {
            // Cameras are not exact.
            let height_m = f64::from(observation[28 * arm + 5]);
            assert!((height_m - expected_m).abs() < 0.005, "{height_m} m");
            assert!((f64::from(goal[3 * arm + 2]) - expected_m).abs() < 1e-6);
            let yaw_rad = 2.0 * f64::from(observation[28 * arm + 14]).asin();
            assert!((yaw_rad - start.yaws_rad[arm]).abs() < 0.05, "{yaw_rad} rad");
        }
    }
}

#[test]
fn arms_that_are_in_each_others_way_do_not_touch_and_keep_their_steps() {
    // Both arms want to be where the other one is.
    let config =
        TrialConfig { time_limit_s: 60.0, ..config(Task::SharedPush, TrialMode::ClosedLoop, 1) };
    let mut ahead = |observation: &[f32], _: &[f32], action: &mut [f32]| {
        for arm in 0..2 {
            let hand = &observation[28 * arm..28 * arm + 3];
            let wanted = [0.15, 0.0, 0.15];
            for axis in 0..3 {
                action[3 * arm + axis] = ((wanted[axis] - hand[axis]) / 0.05).clamp(-1.0, 1.0);
            }
        }
    };
    let report = TrialRunner::new(config).unwrap().run(0, &mut ahead, &mut NoObserver).unwrap();
    assert_eq!(report.touched, Contacts::NONE);
    assert!(report.arms_gap_m > 0.012, "{} m", report.arms_gap_m);
    assert!(report.n_shortened > 0 && report.n_steps > 50, "{report:?}");
}
