//! Equal draws and actions give equal bits.

use std::thread;

use tandem_core::rng::uniform;
use tandem_core::{Contacts, Layout, Stream, Task, WorldSettings, episode_rng};
use tandem_sim::{Env, SimError, WorldConfig};

const SETTINGS: WorldSettings = WorldSettings {
    grasped_start_prob: 0.3,
    grasped_start_env_steps: 0,
    substeps: 20,
    randomization: 0.5,
};

/// The bits of all observations and the contacts of an episode with held random actions.
fn trace(env: &mut Env, episode: u64) -> (Vec<u32>, Vec<Contacts>) {
    let layout = env.layout();
    env.reset(&mut episode_rng(5, episode, Stream::Reset), SETTINGS);
    let mut exploration = episode_rng(5, episode, Stream::Exploration);
    let mut observation = vec![0.0; layout.n_observation()];
    let mut action = vec![0.0; layout.n_action()];
    let (mut bits, mut contacts) = (Vec::new(), Vec::new());
    for step in 0..50 {
        if step % 4 == 0 {
            action.fill_with(|| uniform(&mut exploration, -1.0, 1.0));
        }
        contacts.push(env.step(&action).expect("a finite step"));
        env.observe(&mut observation);
        bits.extend(observation.iter().map(|value| value.to_bits()));
    }
    bits.extend(env.goal().iter().map(|value| value.to_bits()));
    (bits, contacts)
}

fn new_env(layout: Layout) -> Env {
    Env::new(layout, &WorldConfig::default()).expect("a valid world")
}

fn layouts() -> impl Iterator<Item = Layout> {
    let of_task = |task: Task| (task.min_arms()..=2).map(move |n_arms| Layout::new(task, n_arms));
    Task::ALL.into_iter().flat_map(of_task)
}

#[test]
fn an_episode_is_a_function_of_its_draws_and_actions() {
    for layout in layouts() {
        let fresh = trace(&mut new_env(layout), 3);
        let mut used = new_env(layout);
        for other in [8, 9, 3, 10] {
            let traced = trace(&mut used, other);
            assert_eq!(traced == fresh, other == 3, "{layout:?}, episode {other}");
        }
        assert!(trace(&mut used.clone(), 3) == fresh, "{layout:?}: a clone differs");
        assert!(trace(&mut used, 3) == fresh, "{layout:?}: earlier episodes have an influence");
    }
}

#[test]
fn threads_do_not_affect_the_bits() {
    let layout = Layout::new(Task::PickAndPlace, 2);
    let prototype = new_env(layout);
    let alone: Vec<_> = (0..4).map(|episode| trace(&mut prototype.clone(), episode)).collect();
    let prototype = &prototype;
    let together: Vec<_> = thread::scope(|scope| {
        let runs: Vec<_> = (0..4)
            .map(|episode| scope.spawn(move || trace(&mut prototype.clone(), episode)))
            .collect();
        runs.into_iter().map(|run| run.join().unwrap()).collect()
    });
    assert!(alone == together);
}

#[test]
fn snapshots_do_not_affect_the_simulation() {
    for layout in layouts() {
        let run = |look: bool| {
            let mut env = new_env(layout);
            env.reset(&mut episode_rng(1, 1, Stream::Reset), WorldSettings::default());
            let action = vec![0.7; layout.n_action()];
            for _ in 0..20 {
                if look {
                    assert_eq!(env.scene(), env.scene());
                }
                env.step(&action).expect("a finite step");
            }
            env.scene()
        };
        assert_eq!(run(true), run(false));
    }
}

#[test]
fn random_steps_stay_finite() {
    check_random_steps(8);
}

#[test]
#[ignore = "half a minute"]
fn two_hundred_thousand_random_steps_stay_finite() {
    check_random_steps(250);
}

fn check_random_steps(n_episodes: u64) {
    thread::scope(|scope| {
        for layout in layouts() {
            scope.spawn(move || {
                for substeps in [20, 10] {
                    let config = WorldConfig { substeps, ..WorldConfig::default() };
                    let mut env = Env::new(layout, &config).expect("a valid world");
                    // A step of a bar takes as long as ten of other tasks.
                    let n_episodes = if layout.task.shares_object() {
                        n_episodes.div_ceil(10)
                    } else {
                        n_episodes
                    };
                    for episode in 100..100 + n_episodes {
                        let (bits, _) = trace(&mut env, episode);
                        let in_bounds = bits.iter().all(|bits| f32::from_bits(*bits).abs() < 25.0);
                        assert!(in_bounds, "{layout:?}, {substeps} substeps, episode {episode}");
                    }
                }
            });
        }
    });
}

#[test]
fn invalid_actions_are_errors_and_leave_the_state_unchanged() {
    let layout = Layout::new(Task::PickAndPlace, 1);
    let mut env = new_env(layout);
    env.reset(&mut episode_rng(1, 1, Stream::Reset), WorldSettings::default());
    let before = env.scene();
    assert_eq!(env.step(&[0.0; 3]), Err(SimError::ActionLength { got: 3, expected: 4 }));
    let error = env.step(&[0.0, f32::INFINITY, 0.0, 0.0]).unwrap_err();
    assert_eq!(error.to_string(), "action[1] is inf");
    assert_eq!(env.scene(), before);
    assert!(matches!(
        Env::new(Layout::new(Task::Push, 3), &WorldConfig::default()),
        Err(SimError::Arms(3))
    ));
    assert!(matches!(
        Env::new(Layout::new(Task::Push, 0), &WorldConfig::default()),
        Err(SimError::Arms(0))
    ));
}

#[test]
fn actions_are_clamped_to_one() {
    let run = |size: f32| {
        let mut env = new_env(Layout::new(Task::PickAndPlace, 1));
        env.reset(&mut episode_rng(1, 1, Stream::Reset), WorldSettings::default());
        env.step(&[size, -size, size, -size]).unwrap();
        env.scene()
    };
    assert_eq!(run(1.0), run(7.0));
}
