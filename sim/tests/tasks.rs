//! Both tasks can be done, by one arm and by two, and what does the work is friction.

mod scripted;

use scripted::{play, success_rate};
use tandem_core::{Contacts, Layout, Task};
use tandem_sim::{Friction, WorldConfig};

#[test]
fn one_arm_does_either_task_by_rule() {
    for task in Task::ALL {
        let episodes = play(Layout::new(task, 1), &WorldConfig::default(), 200);
        let rate = success_rate(&episodes);
        println!("{task}, 1 arm: {rate}, median miss {:.4} m", median_miss_m(&episodes));
        assert!(rate >= 0.97, "{task}: {rate}");
        assert!(
            episodes.iter().all(|played| !played.contacts.any()),
            "{task}: contact of an arm that is alone"
        );
    }
}

#[test]
fn two_arms_blind_to_each_other_mostly_do_either_task() {
    for task in Task::ALL {
        let episodes = play(Layout::new(task, 2), &WorldConfig::default(), 200);
        let n_with =
            |contact| episodes.iter().filter(|played| played.contacts.contains(contact)).count();
        let (n_arm_arm, n_arm_table) = (n_with(Contacts::ARM_ARM), n_with(Contacts::ARM_TABLE));
        let rate = success_rate(&episodes);
        println!(
            "{task}, 2 arms: {rate}; arms touch in {n_arm_arm}, the table is touched in {n_arm_table} of 200"
        );
        assert!(rate >= 0.80, "{task}: {rate}");
        assert!((1..100).contains(&n_arm_arm), "{task}: arms touch in {n_arm_arm} of 200");
    }
}

#[test]
fn half_as_many_physics_steps_do_as_well() {
    let config = WorldConfig { substeps: 10, ..WorldConfig::default() };
    for task in Task::ALL {
        let rate = success_rate(&play(Layout::new(task, 1), &config, 100));
        println!("{task}, 10 substeps: {rate}");
        assert!(rate >= 0.97, "{task}: {rate}");
    }
}

#[test]
fn slippery_pads_drop_the_object() {
    let slippery = Friction { pads: 0.05, object: 0.05 };
    let config = WorldConfig { pick_and_place: slippery, ..WorldConfig::default() };
    let rate = success_rate(&play(Layout::new(Task::PickAndPlace, 1), &config, 100));
    println!("friction 0.05: {rate}");
    assert!(rate < 0.7, "{rate}");
}

fn median_miss_m(episodes: &[scripted::Played]) -> f32 {
    let mut misses: Vec<f32> = episodes.iter().map(|played| played.miss_m).collect();
    misses.sort_by(f32::total_cmp);
    misses[misses.len() / 2]
}
