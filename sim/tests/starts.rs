//! Initial states: in reach, without contacts, apart from each other, and with goals not yet achieved.

use tandem_core::layout::{GOAL_TOLERANCE_M, Layout, OBSERVATION_PER_ARM, Task};
use tandem_core::reward::{REWARD_PENDING, distance, sparse_reward};
use tandem_core::{ArmIndex, Contacts, Stream, World, WorldSettings, episode_rng};
use tandem_sim::reach::Reach;
use tandem_sim::{Env, WorldConfig};

const N_SEEDS: u64 = 1000;
const HALF_M: f32 = 0.0225;
/// Every episode starts with the objects grasped where the task allows it.
const GRASPED: WorldSettings = WorldSettings {
    grasped_start_prob: 1.0,
    grasped_start_env_steps: 0,
    substeps: 20,
    randomization: 0.0,
};

fn layouts_in(world: World) -> impl Iterator<Item = Layout> {
    let tasks = Task::ALL.into_iter().filter(move |task| task.world() == world);
    tasks.flat_map(|task| (task.min_arms()..=2).map(move |n_arms| Layout::new(task, n_arms)))
}

fn layouts() -> impl Iterator<Item = Layout> {
    World::ALL.into_iter().flat_map(layouts_in)
}

/// Calls `look` with the initial state of each of `N_SEEDS` seeds.
fn each_start(layout: Layout, settings: WorldSettings, mut look: impl FnMut(&mut Env, &[f32])) {
    let mut env = Env::new(layout, &WorldConfig::default()).expect("a valid world");
    let mut observation = vec![0.0; layout.n_observation()];
    // A step of a bar takes as long as ten of other tasks.
    let n_seeds = if layout.task.shares_object() { N_SEEDS / 10 } else { N_SEEDS };
    for seed in 0..n_seeds {
        env.reset(&mut episode_rng(seed, 0, Stream::Reset), settings);
        env.observe(&mut observation);
        look(&mut env, &observation);
    }
}

fn idle(layout: Layout, gripper: f32) -> Vec<f32> {
    let arm_action = [0.0, 0.0, 0.0, gripper];
    layout.arms().flat_map(|_| arm_action[..layout.task.action_per_arm()].to_vec()).collect()
}

#[test]
fn classic_starts_are_in_reach_apart_and_not_yet_successful() {
    for layout in layouts_in(World::Classic) {
        let area_y_m = if layout.n_arms == 1 { 0.15 } else { 0.12 };
        each_start(layout, WorldSettings::default(), |env, observation| {
            for arm in layout.arms() {
                let seen = &observation[layout.observation_of(arm)];
                let goal = &env.goal()[layout.goal_of(arm)];
                assert!(
                    seen[0].abs() <= 0.02
                        && seen[1].abs() <= 0.02
                        && (0.06..0.161).contains(&seen[2])
                );
                for point in [&seen[3..6], goal] {
                    assert!(
                        point[0].abs() <= 0.1201 && point[1].abs() <= area_y_m + 1e-4,
                        "{point:?}"
                    );
                }
                assert!(
                    (seen[5] - HALF_M).abs() < 1e-6 && (HALF_M - 1e-6..0.2726).contains(&goal[2])
                );
                assert_eq!(sparse_reward(&seen[3..6], goal), REWARD_PENDING);
                assert_eq!(&seen[12..16], [0.0, 0.0, 0.0, 1.0]);
            }
            let scene = env.scene();
            for arm in layout.arms() {
                let in_own = distance(
                    &observation[layout.achieved_goal_of(arm)],
                    &env.goal()[layout.goal_of(arm)],
                );
                let in_world = distance(&scene.objects[arm.0].centre, &scene.goals[arm.0]);
                assert!(
                    (in_own - in_world).abs() < 1e-6,
                    "goal and object are given in different frames"
                );
            }
            let apart = |a: [f32; 3], b: [f32; 3]| assert!(distance(&a, &b) >= 0.0699);
            if layout.n_arms == 2 {
                apart(scene.objects[0].centre, scene.objects[1].centre);
                apart(scene.goals[0], scene.goals[1]);
            }
        });
    }
}

#[test]
fn shared_starts_are_in_reach_apart_and_not_yet_successful() {
    for layout in layouts_in(World::Shared) {
        each_start(layout, WorldSettings::default(), |env, observation| {
            for arm in layout.arms() {
                let seen = &observation[layout.observation_of(arm)];
                let goal = &env.goal()[layout.goal_of(arm)];
                let (hand, object) = ([seen[0], seen[1], seen[2]], [seen[3], seen[4], seen[5]]);
                let [near_m, far_m] = Reach::MICO.radii_m(hand[2]);
                let radius_m = Reach::MICO.radius_m(hand);
                assert!((near_m - 1e-5..far_m + 1e-5).contains(&radius_m), "{hand:?}");
                assert!((0.0309..0.3301).contains(&hand[2]), "{hand:?}");
                assert!(Reach::MICO.radius_m(object) < 0.4401, "no room behind {object:?}");
                for point in [&object[..], goal] {
                    assert!((-1e-4..0.2001).contains(&point[0]) && point[1].abs() < 0.1501);
                }
                let holding_m = goal[2].max(0.031);
                let [near_m, far_m] = Reach::MICO.radii_m(holding_m);
                let radius_m = Reach::MICO.radius_m([goal[0], goal[1], goal[2]]);
                assert!((near_m..=far_m).contains(&radius_m), "goal {goal:?}");
                assert!((object[2] - HALF_M).abs() < 1e-6);
                assert!((HALF_M - 1e-6..HALF_M + 0.3).contains(&goal[2]));
                assert!(distance(&object, goal) >= 0.0699);
                let [x, y, z, w] = [seen[12], seen[13], seen[14], seen[15]];
                assert!(x == 0.0 && y == 0.0 && z.abs() < 0.383 && w > 0.92, "{x} {y} {z} {w}");
            }
            let scene = env.scene();
            let flat = |a: [f32; 3], b: [f32; 3]| (a[0] - b[0]).hypot(a[1] - b[1]);
            if layout.n_arms == 2 {
                assert!(flat(scene.objects[0].centre, scene.objects[1].centre) >= 0.1199);
                assert!(flat(scene.goals[0], scene.goals[1]) >= 0.0999);
                let hands = [0, 1].map(|arm: usize| scene.arms[arm].end_effector);
                assert!(flat(hands[0], hands[1]) >= 0.1699);
            }
        });
    }
}

#[test]
fn bars_start_on_the_table_and_their_goals_are_level_and_above_it() {
    let layout = Layout::new(Task::CarryBar, 2);
    for settings in [WorldSettings::default(), GRASPED] {
        let is_held = settings == GRASPED;
        let (mut n_turned, mut n_right) = (0, 0);
        each_start(layout, settings, |env, observation| {
            let scene = env.scene();
            let [left, right] = [0, 1].map(|arm| scene.objects[arm].centre);
            for (arm, handle) in layout.arms().zip([left, right]) {
                let seen = &observation[layout.observation_of(arm)];
                let goal = &env.goal()[layout.goal_of(arm)];
                assert!(distance(&seen[3..6], goal) >= 0.08, "{seen:?} {goal:?}");
                let in_world = distance(&handle, &scene.goals[arm.0]);
                assert!((distance(&seen[3..6], goal) - in_world).abs() < 1e-6);
                let [x, y, z] = env.goal_area();
                for (number, [low, high]) in goal.iter().zip([x, y, z]) {
                    assert!((low - 1e-6..=high + 1e-6).contains(number), "{goal:?}");
                }
                let height_m = seen[5];
                let is_valid = match is_held {
                    true => {
                        (0.1..0.2501).contains(&height_m) && distance(&seen[6..9], &[0.0; 3]) < 0.01
                    }
                    false => (height_m - HALF_M).abs() < 1e-6 && seen[2] > 0.0999,
                };
                assert!(is_valid, "{seen:?}");
                assert!(seen[12].abs() + seen[13].abs() < 1e-6 && seen[15] > 0.98, "not level");
                assert_eq!(seen[14].to_bits(), observation[14].to_bits(), "another angle");
            }
            assert!((distance(&left, &right) - 0.32).abs() < 1e-5);
            let [first, second] = [0, 1].map(|arm| scene.goals[arm]);
            assert!((distance(&first, &second) - 0.32).abs() < 1e-5 && first[2] == second[2]);
            n_turned += u32::from(observation[14].abs() > 0.087);
            n_right += u32::from(left[0] + right[0] > 0.0);
        });
        assert!((30..70).contains(&n_turned) && (30..70).contains(&n_right), "of 100");
    }
}

#[test]
fn shared_starts_fill_the_area_and_objects_point_in_all_directions() {
    for layout in layouts_in(World::Shared) {
        let mut n_far = [0; 3];
        let mut n_turned = 0;
        each_start(layout, WorldSettings::default(), |env, observation| {
            n_far[0] += u32::from(observation[3] > 0.12);
            n_far[1] += u32::from(observation[4].abs() > 0.10);
            n_far[2] += u32::from(env.goal()[0] > 0.12);
            n_turned += u32::from(observation[14].abs() > 0.195);
        });
        // The shares of a uniform distribution are 0.4, 0.33, 0.4 and 0.5; starts out of reach or without an order of
        // service are drawn again.
        assert!(n_far.iter().all(|n| (200..550).contains(n)), "{layout:?}: {n_far:?}");
        assert!((420..580).contains(&n_turned), "{layout:?}: {n_turned}");
    }
}

#[test]
fn half_of_the_goals_are_in_the_air() {
    let n_high = |task, low_m: f32| {
        let mut n_high = 0;
        each_start(Layout::new(task, 1), WorldSettings::default(), |env, _| {
            n_high += u32::from(env.goal()[2] > HALF_M + low_m);
        });
        n_high
    };
    let n_classic = n_high(Task::PickAndPlace, GOAL_TOLERANCE_M);
    assert!((350..450).contains(&n_classic), "{n_classic} of 1000, expected half of four fifths");
    // Goals out of reach are drawn again, and most of them are high.
    let n_shared = n_high(Task::SharedPickAndPlace, 0.0);
    assert!((400..520).contains(&n_shared), "{n_shared} of 1000");
}

#[test]
fn no_start_has_a_contact() {
    for layout in layouts() {
        let gripper = 1.0;
        each_start(layout, WorldSettings::default(), |env, before| {
            let mut after = before.to_vec();
            assert_eq!(env.step(&idle(layout, gripper)).unwrap(), Contacts::NONE);
            env.observe(&mut after);
            for arm in layout.arms() {
                let object = layout.achieved_goal_of(arm);
                let moved_m = distance(&before[object.clone()], &after[object]);
                assert!(
                    moved_m < 3e-4,
                    "{layout:?}: the object moved by {moved_m} m without contact"
                );
            }
        });
    }
}

/// The hands of the shared world tilt: pads of an open gripper and the palm come lower than those of upright hands.
#[test]
fn hands_do_not_touch_large_cubes_at_the_start() {
    let config = WorldConfig { object_half_size_m: 0.045, ..WorldConfig::default() };
    for layout in layouts().filter(|layout| !layout.task.shares_object()) {
        let mut env = Env::new(layout, &config).expect("a valid world");
        let (mut before, mut after) =
            (vec![0.0; layout.n_observation()], vec![0.0; layout.n_observation()]);
        for seed in 0..300 {
            env.reset(&mut episode_rng(seed, 0, Stream::Reset), WorldSettings::default());
            env.observe(&mut before);
            assert_eq!(env.step(&idle(layout, 1.0)).unwrap(), Contacts::NONE, "{layout:?}, {seed}");
            env.observe(&mut after);
            for arm in layout.arms() {
                let object = layout.achieved_goal_of(arm);
                let moved_m = distance(&before[object.clone()], &after[object]);
                assert!(moved_m < 3e-4, "{layout:?}, {seed}: the object moved by {moved_m} m");
            }
        }
    }
}

#[test]
fn large_cubes_do_not_overlap_at_the_start() {
    let edge_m = 0.09;
    let config = WorldConfig { object_half_size_m: 0.5 * edge_m, ..WorldConfig::default() };
    let has_cubes = |it: &Layout| it.n_arms == 2 && !it.task.shares_object();
    for layout in layouts().filter(has_cubes) {
        let mut env = Env::new(layout, &config).expect("a valid world");
        for seed in 0..N_SEEDS {
            env.reset(&mut episode_rng(seed, 0, Stream::Reset), WorldSettings::default());
            let [first, second] = [0, 1].map(|arm| env.scene().objects[arm].centre);
            let apart_m = distance(&first, &second);
            assert!(apart_m >= edge_m * std::f32::consts::SQRT_2 - 1e-4, "{layout:?}: {apart_m}");
        }
    }
}

#[test]
fn grasped_starts_keep_holding_while_the_hand_moves() {
    let grasping = layouts().filter(|layout| layout.task.grasps());
    for layout in grasping {
        let n_arms = layout.n_arms;
        let mut env = Env::new(layout, &WorldConfig::default()).expect("a valid world");
        let mut observation = vec![0.0; layout.n_observation()];
        for seed in 0..if layout.task.shares_object() { 12 } else { 60 } {
            env.reset(&mut episode_rng(seed, 0, Stream::Reset), GRASPED);
            env.observe(&mut observation);
            let before = observation.clone();
            let mut action = idle(layout, -1.0);
            for _ in 0..5 {
                env.step(&action).expect("a finite step");
            }
            for arm in layout.arms() {
                action[layout.action_of(arm)][2] = 0.5;
            }
            for _ in 0..3 {
                env.step(&action).expect("a finite step");
            }
            env.observe(&mut observation);
            for arm in 0..n_arms {
                let of_hand = arm * OBSERVATION_PER_ARM + 6..arm * OBSERVATION_PER_ARM + 9;
                let slip_m = distance(&before[of_hand.clone()], &observation[of_hand]);
                // Pads meet a turned bar, or an upright cube in a tilted hand, at an angle and settle.
                let most_m = match layout.task {
                    task if task.shares_object() => 5e-3,
                    Task::SharedPickAndPlace => 4e-3,
                    _ => 2e-3,
                };
                assert!(slip_m < most_m, "seed {seed}: slipped by {slip_m} m");
                let object_z = layout.achieved_goal_of(ArmIndex(arm)).end - 1;
                // A hand near the ceiling of its workspace cannot rise.
                let can_rise = before[object_z] < 0.29;
                let rose = observation[object_z] > before[object_z] + 0.02;
                assert!(rose || !can_rise, "seed {seed}: not lifted");
            }
        }
    }
}

#[test]
fn push_episodes_never_start_with_a_grasped_object() {
    for layout in layouts().filter(|layout| !layout.task.grasps()) {
        each_start(layout, GRASPED, |_, observation| {
            assert!(observation[9..12].iter().all(|opening_m| opening_m.abs() < 1e-7));
            assert!(observation[5] < HALF_M + 1e-6);
        });
    }
}
