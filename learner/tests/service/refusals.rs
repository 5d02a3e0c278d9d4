//! Refused messages of workers, none of which has an effect.

use tandem_core::task::TaskDescription;
use tandem_core::{Episode, EpisodeKind};
use tandem_learner::Error;
use tandem_proto::{encode_episode, pb};
use tonic::{Code, Status};

use crate::service_tests::run::{Left, Served, Toy, VERSION, calm, learner_config};
use crate::service_tests::toy::{LAYOUT, config};

type Spoil = fn(&mut pb::SubmitEpisodesRequest);

/// A message that is wrong in one place, and the refusal that its sender receives after "worker NAME (ID): ".
const WRONG: [(Spoil, &str); 17] = [
    (
        |m| put(&mut m.episodes[1].observations, 5, f32::NAN),
        "episode 1: observations[5]: expected a finite number, got NaN",
    ),
    (
        |m| put(&mut m.episodes[1].observations, 0, f32::INFINITY),
        "episode 1: observations[0]: expected a finite number, got inf",
    ),
    (
        |m| put(&mut m.episodes[0].goal, 2, f32::NEG_INFINITY),
        "episode 0: goal[2]: expected a finite number, got -inf",
    ),
    (
        |m| put(&mut m.episodes[0].actions, 3, f32::NAN),
        "episode 0: actions[3]: expected a number in [-1, 1], got NaN",
    ),
    (
        |m| put(&mut m.episodes[0].actions, 3, 1.5),
        "episode 0: actions[3]: expected a number in [-1, 1], got 1.5",
    ),
    (
        |m| m.episodes[0].observations.truncate(8),
        "episode 0: observations: expected 1428 numbers, got 2 numbers",
    ),
    (|m| m.episodes[0].goal.clear(), "episode 0: goal: expected 3 numbers, got 0 numbers"),
    (
        |m| m.episodes[0].actions.push(0),
        "episode 0: actions: expected 600 bytes, 4 per number, got 601 bytes",
    ),
    (
        |m| m.episodes[0].contacts.clear(),
        "episode 0: contacts: expected 50 bytes, one per step, got 0 bytes",
    ),
    (|m| m.episodes[0].kind = 0, "episode 0: kind: expected 1 (training) or 2 (evaluation), got 0"),
    (|m| m.episodes[0].kind = 2, "episode 0: kind: expected Training, got Evaluation"),
    (|m| m.episodes[1].number = 77, "episode 77: number: expected 1, got 77"),
    (|m| m.episodes[1].parameter_version = 5, "episode 1: parameter_version: expected 0, got 5"),
    (
        |m| m.episodes[1].advice_charged = 1,
        "episode 1: advice_charged: expected 0, as no advice was ordered, got 1",
    ),
    (|m| m.episodes.extend(m.episodes.clone()), "episodes: expected the 2 of slot 0, got 4"),
    (|m| m.episodes.clear(), "episodes: expected the 2 of slot 0, got 0"),
    (|m| m.slot = 99, "slot: expected one of the 4 that were ordered, got 99"),
];

/// Puts a number into a vector's bytes.
fn put(bytes: &mut [u8], at: usize, value: f32) {
    bytes[4 * at..4 * at + 4].copy_from_slice(&value.to_le_bytes());
}

fn message(toy: &Toy, slot: u64, episodes: &[Episode]) -> pb::SubmitEpisodesRequest {
    let episodes = episodes.iter().map(encode_episode).collect();
    pb::SubmitEpisodesRequest { worker_id: toy.id, slot, episodes, environment_check: None }
}

fn assert_refused(status: &Status, code: Code, message: &str) {
    assert_eq!((status.code(), status.message()), (code, message));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_wrong_message_is_refused_by_name_and_changes_nothing() {
    let expected = calm(config(0)).await;
    let directory = tempfile::tempdir().expect("a directory");
    let served = Served::start(learner_config(config(0), directory.path(), false)).await;
    let mut toy = served.join("arm \"3\"").await;
    let (order, episodes) = toy.take().await.expect("a slot");
    assert_eq!(order.slot, 0);
    for (spoil, refusal) in WRONG {
        let mut wrong = message(&toy, order.slot, &episodes);
        spoil(&mut wrong);
        let status = toy.client.submit_episodes(wrong).await.expect_err("must be refused");
        let refusal = format!("worker \"arm \\\"3\\\"\" ({}): {refusal}", toy.id);
        assert_refused(&status, Code::InvalidArgument, &refusal);
    }
    for stranger in [0, 1, toy.id + 1, u64::MAX] {
        let wrong =
            pb::SubmitEpisodesRequest { worker_id: stranger, ..message(&toy, 0, &episodes) };
        let status = toy.client.submit_episodes(wrong).await.expect_err("must be refused");
        let refusal = format!("worker {stranger} is unknown here: join first");
        assert_refused(&status, Code::NotFound, &refusal);
        let request = pb::NextWorkRequest { worker_id: stranger };
        let status = toy.client.next_work(request).await.expect_err("must be refused");
        assert_refused(&status, Code::NotFound, &refusal);
    }
    toy.deliver(order.slot, &episodes).await.expect("the right one is taken");
    toy.deliver(order.slot, &[]).await.expect("what is in is not looked at");
    while toy.play_one().await {}
    let ended = served.end().await.expect("a run");
    assert_eq!(Left::behind(&ended, directory.path()), expected);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn workers_that_cannot_join_get_the_reason() {
    let directory = tempfile::tempdir().expect("a directory");
    let served = Served::start(learner_config(config(0), directory.path(), false)).await;
    let mut toy = served.join("").await;
    let mut join = async |worker: &str, version: &str| {
        let request = pb::JoinRequest { worker: worker.to_owned(), version: version.to_owned() };
        toy.client.join(request).await.map(drop)
    };
    for (name, refusal) in [
        ("a\nb", "worker: expected no control characters, got U+000A in \"a\\nb\""),
        ("\u{1b}[2J", "worker: expected no control characters, got U+001B in \"\\u{1b}[2J\""),
        ("x\u{0}", "worker: expected no control characters, got U+0000 in \"x\\0\""),
        ("\u{202e}x", "worker: expected no control characters, got U+202E in \"\\u{202e}x\""),
        (&"n".repeat(257), "worker: expected at most 256 bytes, got 257"),
    ] {
        let status = join(name, VERSION).await.expect_err("must be refused");
        assert_refused(&status, Code::InvalidArgument, refusal);
    }
    for version in ["", "0.0.9", &"9".repeat(100_000)] {
        let status = join("toy", version).await.expect_err("must be refused");
        let shown: String = version.chars().take(40).collect();
        let refusal = format!(
            "worker \"toy\" is of version \"{shown}\", this learner of version \"{VERSION}\": both must be the same"
        );
        assert_refused(&status, Code::FailedPrecondition, &refusal);
    }
    join(&"Arm №3 – left ".repeat(8), VERSION).await.expect("any other label will do");
    served.shutdown.cancel();
    served.end().await.expect("interrupted");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_run_whose_slots_exceed_a_message_is_refused_with_the_settings_to_change() {
    let mib = |n_bytes: usize| n_bytes.div_ceil(1 << 20);
    let described = "episode_steps or n_observation of the task's description";
    for (n_observation, episode_steps, rollouts, kind, size_mib, settings) in [
        (4096, 1000, 2, EpisodeKind::Evaluation, 126, described.to_owned()),
        (376, 1000, 64, EpisodeKind::Training, 93, format!("rounds.rollouts, or {described}")),
    ] {
        let description = TaskDescription {
            name: "lab/push".to_owned(),
            n_observation,
            episode_steps,
            observation_bound: vec![3.0; n_observation],
            ..LAYOUT.description()
        };
        let mut run = config(0);
        run.task = description.name.clone();
        run.description = Some(description);
        run.rounds.rollouts = rollouts;
        let directory = tempfile::tempdir().expect("a directory");
        let served = Served::start(learner_config(run, directory.path(), false)).await;
        let error = served.end().await.expect_err("cannot be sent");
        let Error::SlotTooLarge { n_bytes, kind: refused } = &error else { panic!("{error:?}") };
        assert_eq!((mib(*n_bytes), *refused), (size_mib, kind));
        let expected = format!(
            "the episodes of a slot are up to {size_mib} MiB large and a message at most 64: lower {settings}"
        );
        assert_eq!(error.to_string(), expected);
    }
}
