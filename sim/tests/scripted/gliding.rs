//! In the shared world, pushed objects move only while a hand touches them.

use super::Controller;
use rapier3d::math::{Pose, Rotation, Vector};
use rapier3d::parry::query;
use rapier3d::parry::shape::Cuboid as Shape;
use tandem_core::scene::{Cuboid, Scene};
use tandem_core::{ArmIndex, Layout, Stream, Task, WorldSettings, episode_rng};
use tandem_sim::{Env, WorldConfig};

const N_EPISODES: u64 = 100;
/// Distance up to which a hand counts as touching, metres.
const TOUCH_M: f32 = 0.004;
/// Smallest displacement of an object in a control step that counts, metres.
const MOVES_M: f32 = 0.0005;

/// The share of the way of pushed objects without a hand at them, at the end of a control step.
fn gliding_share(task: Task) -> f32 {
    let layout = Layout::new(task, 1);
    let mut env = Env::new(layout, &WorldConfig::default()).expect("a valid world");
    let mut observation = vec![0.0; layout.n_observation()];
    let (mut way_m, mut gliding_m) = (0.0, 0.0);
    for episode in 0..N_EPISODES {
        env.reset(&mut episode_rng(11, episode, Stream::Reset), WorldSettings::default());
        let mut controller = Controller::new(task);
        let mut before = env.scene();
        for _ in 0..layout.description().episode_steps {
            env.observe(&mut observation);
            let inputs = controller.act(&observation, env.goal());
            env.step(&inputs[..layout.n_action()]).expect("a finite step");
            let scene = env.scene();
            let moved_m = (Vector::from_array(scene.objects[0].centre)
                - Vector::from_array(before.objects[0].centre))
            .length();
            if moved_m > MOVES_M {
                way_m += moved_m;
                if hand_distance_m(&scene, ArmIndex(0)) > TOUCH_M {
                    gliding_m += moved_m;
                }
            }
            before = scene;
        }
    }
    gliding_m / way_m
}

/// The distance between an arm's hand and its object.
fn hand_distance_m(scene: &Scene, arm: ArmIndex) -> f32 {
    let placed = |cuboid: &Cuboid| {
        let [x, y, z, w] = cuboid.orientation;
        let orientation = Rotation::from_xyzw(x, y, z, w);
        let pose = Pose::from_parts(Vector::from_array(cuboid.centre), orientation);
        (pose, Shape::new(Vector::from_array(cuboid.half_extents_m)))
    };
    let (object_pose, object) = placed(&scene.objects[arm.0]);
    let distance_m = |part: &Cuboid| {
        let (pose, shape) = placed(part);
        query::distance(&pose, &shape, &object_pose, &object)
            .expect("boxes have a distance")
            .distance
    };
    scene.arms[arm.0].hand.iter().map(distance_m).fold(f32::INFINITY, f32::min)
}

#[test]
fn objects_in_the_shared_world_move_only_while_they_are_touched() {
    let [classic, shared] = [Task::Push, Task::SharedPush].map(gliding_share);
    println!(
        "share of the objects' way without a hand within 4 mm: classic {classic:.3}, shared {shared:.3}"
    );
    assert!(shared < 0.02, "{shared}");
    assert!(shared < 0.5 * classic, "{shared} in the shared world, {classic} in the classic one");
}
