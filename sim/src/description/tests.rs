use super::*;
use tandem_core::Task;

use crate::env::Env;

fn described(task: Task, n_arms: usize) -> WorldDescription {
    let env = Env::new(Layout::new(task, n_arms), &WorldConfig::default()).unwrap();
    env.description()
}

fn mass_kg(world: &WorldDescription, body: usize) -> f32 {
    world.shapes.iter().filter(|shape| shape.body == Some(body)).map(|shape| shape.mass_kg).sum()
}

#[test]
fn masses_are_those_of_the_control_law() {
    let worlds = [Task::Push, Task::PickAndPlace, Task::SharedPush, Task::SharedPickAndPlace];
    for (task, n_arms) in worlds.into_iter().flat_map(|task| [(task, 1), (task, 2)]) {
        let world = described(task, n_arms);
        assert_eq!(world.arms.len(), n_arms);
        for arm in &world.arms {
            let fingers_kg: f32 =
                arm.fingers.iter().map(|finger| mass_kg(&world, finger.body)).sum();
            let own_kg = world.bodies[arm.palm].own_mass_kg;
            let hand_kg = mass_kg(&world, arm.palm) + own_kg + fingers_kg;
            assert!((hand_kg - world.hand.mass_kg).abs() < 1e-6, "{task}: {hand_kg}");
            assert!((mass_kg(&world, arm.object) - 0.1).abs() < 1e-6);
        }
    }
}

#[test]
fn arms_that_share_an_object_bring_two_points_of_one_body_to_their_goals() {
    let world = described(Task::CarryBar, 2);
    let [first, second] = &world.arms[..] else { panic!("two arms") };
    assert_eq!(first.object, second.object);
    assert_eq!(
        [first, second].map(|arm| arm.object_point_m),
        [[-0.16, 0.0, 0.0], [0.16, 0.0, 0.0]]
    );
    assert!((mass_kg(&world, first.object) - 0.5).abs() < 1e-6);
    let own = described(Task::PickAndPlace, 2);
    assert!(own.arms.iter().all(|arm| arm.object_point_m == [0.0; 3]));
    assert_ne!(own.arms[0].object, own.arms[1].object);
}

#[test]
fn no_pair_has_two_shapes_of_one_body() {
    for task in Task::ALL {
        let world = described(task, 2);
        for pair in &world.contact_pairs {
            let [first, second] = pair.shapes.map(|shape| world.shapes[shape].body);
            assert!(first.is_none() || first != second, "{task}: {pair:?}");
        }
    }
}

#[test]
fn pairs_have_the_friction_of_the_decision_records_and_hands_do_not_collide_with_themselves() {
    let world = described(Task::PickAndPlace, 2);
    let mut frictions: Vec<f32> = Vec::new();
    for pair in &world.contact_pairs {
        let [first, second] = pair.shapes.map(|shape| &world.shapes[shape]);
        let is_one_hand = first.part == Part::Hand && second.part == Part::Hand;
        assert!(!(is_one_hand && first.arm == second.arm), "{pair:?}");
        if [first.part, second.part] == [Part::Table, Part::Object] {
            assert_eq!(pair.friction, 0.6);
        }
        frictions.push(pair.friction);
    }
    frictions.sort_by(f32::total_cmp);
    frictions.dedup();
    assert_eq!(frictions, [0.4, 0.45, 0.6]);
    assert_eq!(world.contact_pairs.len(), 2 + 10 + 1 + 20 + 25);
}

#[test]
fn the_fingers_of_a_locked_gripper_are_shapes_of_the_palm() {
    let n_shapes = |task| {
        let world = described(task, 1);
        let palm = Some(world.arms[0].palm);
        (world.bodies.len(), world.shapes.iter().filter(|shape| shape.body == palm).count())
    };
    assert_eq!(n_shapes(Task::Push), (2, 5));
    assert_eq!(n_shapes(Task::PickAndPlace), (5, 2));
}
