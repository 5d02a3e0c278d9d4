//! Contacts: what they cost, which advice they keep from being cloned, and which steps make them.

use super::*;

#[test]
fn a_contact_costs_both_arms_and_stops_cloning_before_it() {
    let mut episode = episode();
    episode.contacts[20] = Contacts::ARM_ARM;
    let mut buffer = ReplayBuffer::new(LAYOUT, 1000);
    buffer.push(&episode);
    let change = |config: &mut ReplayConfig| {
        config.arm_swap_prob = 0.0;
        config.her_ratio = 0.0;
        (config.contact_cost, config.contact_foresight_steps) = (0.75, 3);
    };
    let batch = filled(change, &buffer);
    let mut seen = [false; EPISODE_STEPS];
    for (row, rewards) in batch.rewards.chunks_exact(2).enumerate() {
        let of_step = |step: &usize| batch.actions[row * 6] == (*step * 6) as f32;
        let step = (0..EPISODE_STEPS).find(of_step).expect("the action of a step");
        seen[step] = true;
        assert_eq!(rewards, if step == 20 { [-1.75; 2] } else { [-1.0; 2] }, "step {step}");
        let cloned = if (18..=20).contains(&step) { 0.0 } else { 1.0 };
        assert_eq!(batch.bc_mask[row * 6], cloned, "step {step}");
    }
    assert!(seen[17..=21].iter().all(|seen| *seen), "too few draws");
}

#[test]
fn a_contact_of_one_arm_with_the_table_costs_that_arm_only() {
    let mut episode = episode();
    episode.contacts[20] = Contacts::TABLE_OF[1];
    episode.contacts[21] = Contacts::TABLE_OF[1] | Contacts::ARM_ARM;
    let mut buffer = ReplayBuffer::new(LAYOUT, 1000);
    buffer.push(&episode);
    for swapped in [false, true] {
        let change = |config: &mut ReplayConfig| {
            config.arm_swap_prob = if swapped { 1.0 } else { 0.0 };
            config.her_ratio = 0.0;
            config.contact_cost = 0.75;
        };
        let batch = filled(change, &buffer);
        let mut seen = [false; 2];
        for (row, rewards) in batch.rewards.chunks_exact(2).enumerate() {
            let first = if swapped { row * 6 + 3 } else { row * 6 };
            let mut expected = match batch.actions[first] {
                120.0 => [-1.0, -1.75],
                126.0 => [-1.75, -1.75],
                _ => [-1.0; 2],
            };
            seen[0] |= batch.actions[first] == 120.0;
            seen[1] |= batch.actions[first] == 126.0;
            if swapped {
                expected.reverse();
            }
            assert_eq!(rewards, expected);
        }
        assert_eq!(seen, [true; 2], "too few draws");
    }
}

#[test]
fn steps_after_which_hands_would_overlap_make_a_contact() {
    let layout = Layout::new(Task::SharedPush, 2);
    let mut description = layout.description();
    description.name = "described-contacts".to_owned();
    description.contact_distances = vec![0.065, 0.08, 0.15];
    let task = TaskSpec::new(description).unwrap();
    // Each arm has its hand in the middle in one episode, and far back in the other.
    let episode_of = |number: u64, in_middle: usize| {
        let mut episode = Episode::zeros(task.clone(), number);
        episode.goal.fill(9.0);
        episode.actions.fill(0.1 * number as f32);
        episode.advised_arms.fill(0b11);
        for observation in episode.observations.chunks_exact_mut(layout.n_observation()) {
            for arm in layout.arms() {
                let part = &mut observation[layout.observation_of(arm)];
                let x = if arm.0 == in_middle { 0.12 } else { -0.2 };
                part[..5].copy_from_slice(&[x, 0.0, 0.0, -0.1, 0.1]);
            }
        }
        episode
    };
    let mut buffer = ReplayBuffer::new(task.clone(), 1000);
    buffer.push(&episode_of(0, 0));
    buffer.push(&episode_of(1, 1));
    let identity = |n| NormalizerSnapshot { mean: vec![0.0; n], std: vec![1.0; n] };
    let (observation, goal) = (identity(56), identity(6));
    let statistics = Statistics { observation: &observation, goal: &goal };
    let n_contacts = |coda_contact_prob| {
        let config = ReplayConfig {
            coda_contact_prob,
            coda_fraction: 1.0,
            arm_swap_prob: 0.0,
            her_ratio: 0.0,
            contact_cost: 0.75,
            contact_foresight_steps: 3,
            ..config(RewardKind::PerArm)
        };
        let mut batch = Batch::new(task.clone(), 2, 400);
        let mut rng = episode_rng(3, 0, Stream::Replay);
        Sampler::new(&config, task.clone()).fill(&buffer, statistics, &mut rng, &mut batch);
        let rows = batch.actions.chunks_exact(6).zip(batch.bc_mask.chunks_exact(6));
        let touches =
            rows.zip(batch.rewards.chunks_exact(2)).map(|((action, bc_mask), rewards)| {
                // The first arm's part is from the first episode, the second arm's from the second one.
                let touches = (action[0], action[3]) == (0.0, 0.1);
                assert_eq!(rewards, if touches { [-1.75; 2] } else { [-1.0; 2] });
                assert_eq!(bc_mask, if touches { [0.0; 6] } else { [1.0; 6] });
                touches
            });
        touches.filter(|touches| *touches).count()
    };
    assert_eq!(n_contacts(0.0), 0);
    let (half, all) = (n_contacts(0.5), n_contacts(1.0));
    assert!((70..130).contains(&all), "a quarter of 400: {all}");
    assert!((30..70).contains(&half), "an eighth of 400: {half}");
}
