//! Neither the number of workers, nor the order in which they deliver, nor the number of threads shows.

use std::time::Duration;

use rand_chacha::ChaCha8Rng;
use tandem_core::rng::{Stream, episode_rng, index};
use tandem_learner::LearnerConfig;

use crate::service_tests::run::{Left, Served, Toy, calm, deliver_as, learner_config};
use crate::service_tests::toy::config;

/// Plays slots in its own time, delivers some twice, and some in another worker's name.
async fn play_restlessly(mut toy: Toy, mut rng: ChaCha8Rng, all_ids: Vec<u64>) {
    while let Some((order, episodes)) = toy.take().await {
        tokio::time::sleep(Duration::from_micros(index(&mut rng, 3000) as u64)).await;
        let name =
            if index(&mut rng, 4) == 0 { all_ids[index(&mut rng, all_ids.len())] } else { toy.id };
        let n_times = 1 + index(&mut rng, 3);
        for _ in 0..n_times {
            if deliver_as(&mut toy.client, name, order.slot, &episodes).await.is_err() {
                return;
            }
        }
        if index(&mut rng, 5) == 0 {
            let (slot, wrong) = (order.slot, &episodes[1..]);
            // Refused while the slot is open, ignored when it is in, as it is.
            deliver_as(&mut toy.client, toy.id, slot, wrong).await.expect("it is in");
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_order_of_arrival_does_not_affect_the_run() {
    for lag in [0, 1] {
        let expected = calm(config(lag)).await;
        assert_eq!(expected.rows.len(), 5, "after rounds 2, 4, 6, 8 and 9");
        for seed in 0..8 {
            let directory = tempfile::tempdir().expect("a directory");
            let served = Served::start(learner_config(config(lag), directory.path(), false)).await;
            let mut toys = Vec::new();
            for n in 0..1 + seed {
                toys.push(served.join(&format!("toy-{n}")).await);
            }
            let ids: Vec<u64> = toys.iter().map(|toy| toy.id).collect();
            for (n, toy) in (0..).zip(toys) {
                let rng = episode_rng(seed, n, Stream::Exploration);
                tokio::spawn(play_restlessly(toy, rng, ids.clone()));
            }
            let ended = served.end().await.expect("a run");
            assert_eq!(Left::behind(&ended, directory.path()), expected, "lag {lag}, seed {seed}");
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_number_of_threads_does_not_affect_the_run() {
    let mut run = config(0);
    // Several blocks of rows, which threads share.
    (run.ddpg.n_hidden, run.ddpg.batch_size) = (64, 300);
    let expected = calm(run.clone()).await;
    for n_threads in [2, 5] {
        let directory = tempfile::tempdir().expect("a directory");
        let config =
            LearnerConfig { n_threads, ..learner_config(run.clone(), directory.path(), false) };
        let ended = Served::start(config).await.finish(1).await.expect("a run");
        assert_eq!(Left::behind(&ended, directory.path()), expected, "{n_threads} threads");
    }
}
