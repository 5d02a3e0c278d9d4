use tandem_core::Task;

use super::*;
use crate::hand::THREE_FINGERS;
use crate::parameters::WorldParameters;
use tandem_core::rng::uniform;
use tandem_core::{Stream, TaskSpec, episode_rng};

const N_STEPS: usize = 12;
const ARM: ArmIndex = ArmIndex(0);
const NUDGE_M: Vector = Vector::splat(1e-7);

/// Exchanges the parts of the two arms in a vector.
fn swapped(both: &[f32]) -> Vec<f32> {
    let (first, second) = both.split_at(both.len() / 2);
    [second, first].concat()
}

/// The observations of two arms that start at `arms` and approach their own objects with some noise.
fn observations(env: &mut Env, arms: &[ArmStart], noise: &[Vec<f32>]) -> Vec<Vec<f32>> {
    env.world = env.prototype.clone();
    env.place(arms);
    let layout = env.layout;
    let mut observation = vec![0.0; layout.n_observation()];
    noise
        .iter()
        .map(|noise| {
            env.observe(&mut observation);
            let mut action = noise.clone();
            for arm in layout.arms() {
                let to_object = &observation[layout.observation_of(arm)][6..9];
                for (input, offset_m) in action[layout.action_of(arm)].iter_mut().zip(to_object) {
                    *input += 10.0 * offset_m;
                }
            }
            env.step(&action).unwrap();
            env.observe(&mut observation);
            observation.clone()
        })
        .collect()
}

/// For each step the largest difference in a position of a hand or an object between two trajectories, metres.
fn difference_m(layout: Layout, one: &[Vec<f32>], other: &[Vec<f32>]) -> Vec<f32> {
    let positions: Vec<usize> =
        layout.arms().flat_map(|arm| layout.observation_of(arm).take(6)).collect();
    let largest = |one: &[f32], other: &[f32]| {
        positions.iter().map(|&idx| (one[idx] - other[idx]).abs()).fold(0.0, f32::max)
    };
    one.iter().zip(other).map(|(one, other)| largest(one, other)).collect()
}

/// The 90th percentile over episodes of the difference at `step`.
fn percentile_90_m(differences_m: &[Vec<f32>], step: usize) -> f32 {
    let mut sorted: Vec<f32> = differences_m.iter().map(|episode| episode[step]).collect();
    sorted.sort_by(f32::total_cmp);
    sorted[sorted.len() * 9 / 10]
}

fn world_of_two() -> PhysicsWorld {
    PhysicsWorld::build(Layout::new(Task::PickAndPlace, 2), &WorldConfig::default())
}

/// The contacts of hands that stay at `hands`, in arm frames, for a control step.
fn contacts_at(hands: [Vector; 2]) -> Contacts {
    let mut world = world_of_two();
    for (arm, hand) in [ArmIndex(0), ArmIndex(1)].into_iter().zip(hands) {
        world.place_arm(arm, hand, THREE_FINGERS.max_opening_m);
        world.place_object(arm, Vector::new(-0.1, 0.2, 0.0225), 0.0);
    }
    world.reset_link_avoidance();
    let stay = world.arms.iter().map(|arm| arm.hand.end_effector(&world.physics));
    let commands: Vec<Command> = stay.map(|target| Command { target, gripper: 1.0 }).collect();
    world.step(&[commands[0], commands[1]]).unwrap()
}

#[test]
fn a_goal_moves_to_the_nearest_point_of_its_area() {
    let mut env = Env::new(Layout::new(Task::PickAndPlace, 2), &WorldConfig::default()).unwrap();
    env.reset(&mut episode_rng(1, 0, Stream::Reset), WorldSettings::default());
    let other = env.goal()[..3].to_vec();
    env.move_goal(ArmIndex(1), [0.05, -0.5, 0.1]);
    assert_eq!(env.goal()[..3], other);
    let expected = [0.07, 0.12, 0.1];
    let near = |(got, expected): (&f32, f32)| (got - expected).abs() < 1e-6;
    assert!(env.goal()[3..].iter().zip(expected).all(near), "{:?}", env.goal());
    assert_eq!(env.scene().goals[1][1], -0.12);
    for episode in 0..20 {
        env.reset(&mut episode_rng(1, episode, Stream::Reset), WorldSettings::default());
        let (area, goals) = (env.goal_area(), env.goal().as_chunks::<3>().0);
        let is_inside = |goal: &[f32; 3]| {
            (0..3).all(|axis| (area[axis][0]..=area[axis][1]).contains(&goal[axis]))
        };
        assert!(goals.iter().all(is_inside), "{goals:?} outside {area:?}");
    }
}

#[test]
fn contacts_between_hands_and_with_the_table_are_distinguished() {
    let high = Vector::new(0.0, 0.0, 0.15);
    assert_eq!(contacts_at([high, high]), Contacts::NONE);
    let lowest =
        Vector::new(0.0, 0.0, WorldParameters::of(tandem_core::World::Classic).workspace_low.z);
    assert_eq!(
        contacts_at([lowest, lowest]),
        Contacts::NONE,
        "the workspace's floor keeps the pads off the table"
    );
    let on_table = Vector::new(0.0, 0.0, THREE_FINGERS.pad_half.z - 0.001);
    assert_eq!(contacts_at([on_table, high]), Contacts::ARM_TABLE);
    assert_eq!(contacts_at([high, on_table]), Contacts::ARM_TABLE);
    let meeting = high + Vector::X * 0.09;
    assert_eq!(contacts_at([meeting, meeting]), Contacts::ARM_ARM);
}

/// The contacts of a control step in which a hand moves by `action` from `hand`, with its cube at the origin.
fn contacts_of_a_move(task: Task, hand: Vector, action: Vector) -> Contacts {
    let mut world = PhysicsWorld::build(Layout::new(task, 1), &WorldConfig::default());
    world.place_arm(ARM, hand, 0.0);
    world.place_object(ARM, Vector::new(0.05, 0.0, 0.0225), 0.0);
    world.reset_link_avoidance();
    let target = world.arms[0].target(&world.physics, action);
    let command = Command { target, gripper: -1.0 };
    let mut contacts = Contacts::NONE;
    for _ in 0..2 {
        contacts = contacts | world.step(&[command; MAX_ARMS]).unwrap();
    }
    contacts
}

#[test]
fn a_hand_that_presses_a_cube_onto_the_table_touches_the_table_in_the_shared_world() {
    let (above, beside) = (Vector::new(0.05, 0.0, 0.07), Vector::new(-0.01, 0.0, 0.031));
    let press = |task| contacts_of_a_move(task, above, Vector::NEG_Z);
    assert_eq!(press(Task::SharedPush), Contacts::TABLE_OF[0]);
    assert_eq!(press(Task::Push), Contacts::NONE);
    assert_eq!(contacts_of_a_move(Task::SharedPush, beside, Vector::X), Contacts::NONE);
}

#[test]
fn hands_that_come_near_touch_in_a_world_with_a_margin() {
    let contacts_at = |contact_margin_m, apart_m: f32| {
        let config = WorldConfig::default();
        let mut world = PhysicsWorld::build(Layout::new(Task::SharedPush, 2), &config);
        let mut rng = episode_rng(1, 0, Stream::Reset);
        let nominal = DomainRandomization::draw(&mut rng, Task::SharedPush, &config, 0.0);
        world.vary(&DomainRandomization { contact_margin_m, ..nominal });
        for arm in [ARM, ArmIndex(1)] {
            world.place_arm(arm, Vector::new(0.12 - 0.5 * apart_m, 0.0, 0.1), 0.0);
            world.place_object(arm, Vector::new(-0.1, 0.2, 0.0225), 0.0);
        }
        world.reset_link_avoidance();
        let stay = world.arms.iter().map(|arm| arm.hand.end_effector(&world.physics));
        let commands: Vec<Command> = stay.map(|target| Command { target, gripper: -1.0 }).collect();
        world.step(&[commands[0], commands[1]]).unwrap()
    };
    // The capsules of the fingers have a radius of 3.5 cm.
    assert_eq!(contacts_at(0.02, 0.085), Contacts::ARM_ARM);
    assert_eq!(contacts_at(0.01, 0.085), Contacts::NONE);
    assert_eq!(contacts_at(0.0, 0.06), Contacts::NONE, "the pads are apart");
}

/// For each step the 90th percentiles over episodes of the differences that swapping the arms and that displacing
/// the objects by a tenth of a micrometre make, metres.
fn differences_m(task: Task, n_episodes: u64) -> Vec<[f32; 2]> {
    let layout = Layout::new(task, 2);
    let mut env = Env::new(layout, &WorldConfig::default()).unwrap();
    let (mut by_swapping, mut by_nudging) = (Vec::new(), Vec::new());
    for episode in 0..n_episodes {
        let mut rng = episode_rng(2, episode, Stream::Reset);
        let settings = WorldSettings { grasped_start_prob: 0.3, ..WorldSettings::default() };
        let [first, second] =
            sample_starts(&mut rng, layout, env.config.object_half_size_m, settings)[..]
        else {
            panic!()
        };
        let mut noise = || (0..layout.n_action()).map(|_| uniform(&mut rng, -0.5, 0.5)).collect();
        let noise: Vec<Vec<f32>> = (0..N_STEPS).map(|_| noise()).collect();
        let noise_swapped: Vec<Vec<f32>> = noise.iter().map(|both| swapped(both)).collect();
        let nudge = |start: ArmStart| ArmStart { object: start.object + NUDGE_M, ..start };
        // Nudges of both ends of a bar would cancel each other.
        let nudged = match task.shares_object() {
            true => [nudge(first), second],
            false => [nudge(first), nudge(second)],
        };

        let original = observations(&mut env, &[first, second], &noise);
        let mirrored = observations(&mut env, &[second, first], &noise_swapped);
        let mirrored: Vec<_> = mirrored.iter().map(|both| swapped(both)).collect();
        by_swapping.push(difference_m(layout, &original, &mirrored));
        by_nudging.push(difference_m(layout, &original, &observations(&mut env, &nudged, &noise)));
    }
    (0..N_STEPS)
        .map(|step| [percentile_90_m(&by_swapping, step), percentile_90_m(&by_nudging, step)])
        .collect()
}

#[test]
fn objects_that_leave_the_shared_table_fall_to_the_floor() {
    let layout = Layout::new(Task::SharedPickAndPlace, 2);
    let mut env = Env::new(layout, &WorldConfig::default()).unwrap();
    let mut rng = episode_rng(3, 0, Stream::Reset);
    let half_m = env.config.object_half_size_m;
    let mut starts = sample_starts(&mut rng, layout, half_m, WorldSettings::default());
    for start in &mut starts {
        start.object = Vector::new(1.2, 0.0, 0.1);
    }
    let noise = vec![vec![0.0; layout.n_action()]; tandem_core::layout::EPISODE_STEPS];
    let observations = observations(&mut env, &starts, &noise);
    for arm in layout.arms() {
        let object_z = layout.observation_of(arm).start + 5;
        let (fallen, last) = (observations[30][object_z], observations[noise.len() - 1][object_z]);
        assert!(last < -0.7 && (fallen - last).abs() < 1e-3, "{fallen}, {last}");
    }
}

/// Contacts amplify rounding errors, so the symmetry is exact only before the first contact. After it, swapping
/// changes a trajectory about as much as a displacement of the objects by 0.1 µm does. A control step of the shared
/// world has four times as many physics steps, so that a grasped object amplifies errors to a tenth of a millimetre
/// within the first one. Its hands tilt, and rounding decides which corners of a tilted pad and a cube touch first; in
/// push its pads consist of two parts, whose contacts the solver takes in an order. Nudges change neither, and a cube
/// moves by hundredths or tenths of a millimetre. The solver takes the contacts of a bar with both hands and both tables
/// in an order, so swapping changes its way by up to a millimetre.
#[test]
fn swapping_the_arms_is_a_symmetry() {
    for task in Task::ALL {
        let (n_episodes, most, corners_m, first_m) = match task {
            Task::Push => (120, 1.5, 0.0, 5e-6),
            Task::PickAndPlace => (240, 1.5, 0.0, 5e-6),
            Task::SharedPush => (30, 3.0, 5e-4, 5e-6),
            Task::SharedPickAndPlace => (30, 3.0, 5e-5, 5e-4),
            Task::CarryBar => (16, 10.0, 0.0, 5e-4),
        };
        let differences_m = differences_m(task, n_episodes);
        for (step, [swapping, nudging]) in differences_m.iter().enumerate() {
            assert!(
                *swapping <= most * nudging + corners_m,
                "{task}, step {step}: {swapping} m by swapping, {nudging} m by nudging"
            );
        }
        let swapping = differences_m[0][0];
        assert!(swapping < first_m, "{task}: {swapping} m after one step");
    }
}

/// Trajectories from reflected starts, under reflected actions, are the reflected trajectories: exactly before the
/// first contact. The solver takes the contacts of a cube's corners in an order, so later they differ by
/// millimetres.
#[test]
fn the_shared_world_has_a_mirror_image() {
    for (task, n_arms, most_m) in [
        (Task::SharedPush, 1, 0.01),
        (Task::SharedPickAndPlace, 1, 0.02),
        (Task::SharedPush, 2, 0.01),
        (Task::SharedPickAndPlace, 2, 0.02),
    ] {
        let layout = Layout::new(task, n_arms);
        let mut env = Env::new(layout, &WorldConfig::default()).unwrap();
        let differences_m: Vec<Vec<f32>> =
            (0..30).map(|episode| reflection_difference_m(&mut env, episode)).collect();
        assert!(percentile_90_m(&differences_m, 0) < 1e-6, "{task}:");
        for step in 0..N_STEPS {
            let difference_m = percentile_90_m(&differences_m, step);
            assert!(difference_m < most_m, "{task}, step {step}: {difference_m} m");
        }
    }
}

/// For each step the difference between a trajectory and the reflection of that from the reflected start, metres.
fn reflection_difference_m(env: &mut Env, episode: u64) -> Vec<f32> {
    let layout = env.layout;
    let spec = TaskSpec::from(layout);
    let mut rng = episode_rng(2, episode, Stream::Reset);
    let starts =
        sample_starts(&mut rng, layout, env.config.object_half_size_m, WorldSettings::default());
    let mut noise = || (0..layout.n_action()).map(|_| uniform(&mut rng, -0.5, 0.5)).collect();
    let noise: Vec<Vec<f32>> = (0..N_STEPS).map(|_| noise()).collect();
    let mut reflected_noise = noise.clone();
    for (action, reflected) in noise.iter().zip(&mut reflected_noise) {
        layout.arms().for_each(|arm| spec.reflect_action(arm, arm, action, reflected));
    }
    let mirror = |point: Vector| Vector::new(point.x, -point.y, point.z);
    let reflect = |start: &ArmStart| ArmStart {
        end_effector: mirror(start.end_effector),
        object: mirror(start.object),
        object_yaw_rad: -start.object_yaw_rad,
        ..*start
    };
    let reflected_starts: Vec<ArmStart> = starts.iter().map(reflect).collect();
    let original = observations(env, &starts, &noise);
    let mut reflected = observations(env, &reflected_starts, &reflected_noise);
    for observation in &mut reflected {
        let original = observation.clone();
        layout.arms().for_each(|arm| spec.reflect_observation(arm, arm, &original, observation));
    }
    difference_m(layout, &original, &reflected)
}
