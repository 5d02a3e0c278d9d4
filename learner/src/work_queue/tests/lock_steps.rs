//! Claims of advice whose units pay for lock steps.

use super::*;

#[test]
fn the_first_advised_episode_claims_the_lock_steps_of_its_slot() {
    let check = |charged: [u32; 3], expected: &str| {
        let mut ordered = order(0, EpisodeKind::Training);
        let (first, template) = (ordered.episodes[0], played(0).remove(0));
        ordered.episodes =
            (0..3).map(|number| EpisodeOrder { number, advised: number > 0, ..first }).collect();
        let episode = |number: u64| Episode { number, ..template.clone() };
        let mut episodes: Vec<Episode> = (0..3).map(episode).collect();
        episodes[1].advised_arms[..3].copy_from_slice(&[1, 0, 1]);
        episodes[2].advised_arms[..3].copy_from_slice(&[0, 0, 3]);
        for (episode, charged) in episodes.iter_mut().zip(charged) {
            episode.advice_charged = charged;
        }
        let mut queue = WorkQueue { advice_unit: AdviceUnit::SlotStep, ..WorkQueue::default() };
        queue.push(ordered);
        let worker = join(&mut queue, at(0));
        next_slot(&mut queue, worker, at(0));
        let outcome = queue.submit(worker, 0, episodes, at(0)).map_err(|error| error.to_string());
        assert_eq!(outcome.err().unwrap_or_default(), expected, "{charged:?}");
    };
    check([0, 2, 0], "");
    let steps = "the steps with an advised arm";
    check([0, 2, 1], &format!("episode 2: advice_charged: expected 0, {steps}, got 1"));
    check([0, 3, 0], &format!("episode 1: advice_charged: expected 2, {steps}, got 3"));
    check([1, 2, 0], "episode 0: advice_charged: expected 0, as no advice was ordered, got 1");
}

#[test]
fn advice_after_the_ordered_steps_is_refused() {
    let check = |advised_steps, expected: Result<bool, &str>| {
        let (mut ordered, episodes) = advised(2, &[0, 1, 3]);
        ordered.episodes[0].advised_steps = advised_steps;
        let mut queue = WorkQueue::default();
        queue.push(ordered);
        let worker = join(&mut queue, at(0));
        next_slot(&mut queue, worker, at(0));
        let outcome = queue.submit(worker, 0, episodes, at(0)).map_err(|e| e.to_string());
        assert_eq!(outcome, expected.map_err(str::to_owned));
    };
    check(None, Ok(true));
    check(Some(3), Ok(true));
    let refused = "episode 0: advised_arms: expected no advised arm after the first 2 steps, got \
                   0b00000011 on step 2";
    check(Some(2), Err(refused));
}
