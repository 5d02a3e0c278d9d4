//! A disk that is full or refuses.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;
use std::time::Duration;

use tandem_learner::{Error, LearnerConfig, checkpoint};
use tandem_proto::pb;

use crate::service_tests::run::{DEADLINE, Left, Served, Toy, calm, learner_config, real_clock};
use crate::service_tests::toy::config;
use crate::skipped::skip;

const NOT_MOUNTED: &str = "a run on a full disk: this process may not mount a disk";

/// A disk of one megabyte; mounting it requires privileges.
struct SmallDisk {
    path: PathBuf,
    _keep: tempfile::TempDir,
}

impl SmallDisk {
    fn mount() -> Option<Self> {
        let keep = tempfile::tempdir().expect("a directory");
        let mounted = Command::new("mount")
            .args(["-t", "tmpfs", "-o", "size=1m", "tmpfs"])
            .arg(keep.path())
            .output();
        match mounted {
            Ok(output) if output.status.success() => {
                Some(Self { path: keep.path().to_owned(), _keep: keep })
            }
            _ => None,
        }
    }

    /// Takes all the room there is.
    fn fill(&self) {
        let block = vec![7_u8; 4096];
        let mut ballast = std::fs::File::create(self.path.join("ballast")).expect("creates");
        let full = std::iter::repeat_with(|| std::io::Write::write_all(&mut ballast, &block))
            .find_map(Result::err)
            .expect("it is finite");
        assert_eq!(full.kind(), std::io::ErrorKind::StorageFull);
    }

    fn make_room(&self) {
        std::fs::remove_file(self.path.join("ballast")).expect("removes");
    }

    fn remount(&self, how: &str) {
        let option = format!("remount,{how}");
        let status = Command::new("mount").args(["-o", &option]).arg(&self.path).status();
        assert!(status.expect("mount runs").success(), "{option}");
    }
}

impl Drop for SmallDisk {
    fn drop(&mut self) {
        let lazily = Command::new("umount").arg("-l").arg(&self.path).status();
        assert!(lazily.is_ok_and(|status| status.success()), "still mounted: {:?}", self.path);
    }
}

/// A learner whose disk is tried again at every look: its clock runs a thousand times as fast.
fn impatient(out: &Path, resume: bool) -> LearnerConfig {
    let clock = real_clock();
    LearnerConfig {
        clock: Arc::new(move || clock() * 1000),
        ..learner_config(config(0), out, resume)
    }
}

async fn play(toy: &mut Toy, n_slots: usize) {
    for _ in 0..n_slots {
        assert!(toy.play_one().await);
    }
}

/// Plays until the first checkpoint is written.
async fn play_to_the_first_checkpoint(toy: &mut Toy, out: &Path) {
    play(toy, TO_THE_FIRST_CHECKPOINT).await;
    let saved = async {
        while checkpoint::list(&out.join("checkpoint")).is_empty() {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    };
    tokio::time::timeout(DEADLINE, saved).await.expect("in time");
}

/// Plays slot after slot until there is such a warning, which is looked for before each.
async fn play_until_warned(toy: &mut Toy, is_awaited: impl Fn(&str) -> bool) -> String {
    loop {
        let progress = toy.client.status(pb::StatusRequest {}).await.expect("it lives");
        let warning = progress.into_inner().warning;
        if is_awaited(&warning) {
            return warning;
        }
        assert!(
            toy.play_one().await,
            "the run ended without the warning, the last one was {warning:?}"
        );
    }
}

/// Slots of three rounds and an evaluation: then a checkpoint is written.
const TO_THE_FIRST_CHECKPOINT: usize = 14;

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_full_disk_is_reported_and_nothing_is_lost_once_there_is_room() {
    let Some(disk) = SmallDisk::mount() else {
        skip("MOUNTS", NOT_MOUNTED);
        return;
    };
    let expected = calm(config(0)).await;
    let out = disk.path.join("run");
    let served = Served::start(impatient(&out, false)).await;
    let mut toy = served.join("toy").await;
    play_to_the_first_checkpoint(&mut toy, &out).await;
    disk.fill();
    let warning_text =
        play_until_warned(&mut toy, |warning_text| warning_text.contains("checkpoint")).await;
    assert!(warning_text.contains("cannot be written: No space left on device"), "{warning_text}");
    assert!(!checkpoint::list(&out.join("checkpoint")).is_empty(), "the former one stays");
    disk.make_room();
    while toy.play_one().await {}
    let ended = served.end().await.expect("everything is written");
    assert_eq!(Left::behind(&ended, &out), expected);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_disk_that_stays_full_ends_the_run_with_an_error_and_it_can_be_resumed() {
    let Some(disk) = SmallDisk::mount() else {
        skip("MOUNTS", NOT_MOUNTED);
        return;
    };
    let expected = calm(config(0)).await;
    let out = disk.path.join("run");
    let served = Served::start(impatient(&out, false)).await;
    let mut toy = served.join("toy").await;
    play_to_the_first_checkpoint(&mut toy, &out).await;
    disk.fill();
    while toy.play_one().await {}
    let error = served.end().await.expect_err("not everything is written");
    let Error::Unwritten { trouble, .. } = &error else { panic!("{error}") };
    for what in ["the checkpoint of round 9", "No space left on device"] {
        assert!(trouble.contains(what), "{trouble}");
    }
    disk.make_room();
    let again = Served::start(learner_config(config(0), &out, true)).await;
    let ended = again.finish(1).await.expect("continues");
    assert_eq!(Left::behind(&ended, &out), expected);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_read_only_disk_is_reported_and_written_once_it_recovers() {
    let Some(disk) = SmallDisk::mount() else {
        skip("MOUNTS", NOT_MOUNTED);
        return;
    };
    let expected = calm(config(0)).await;
    let out = disk.path.join("run");
    let served = Served::start(impatient(&out, false)).await;
    let mut toy = served.join("toy").await;
    play_to_the_first_checkpoint(&mut toy, &out).await;
    // Nothing is being written: the learner waits for the last slot of a round.
    let (order, episodes) = toy.take().await.expect("a slot");
    disk.remount("ro");
    toy.deliver(order.slot, &episodes).await.expect("taken");
    let mut warning_text = String::new();
    while warning_text.is_empty() {
        assert!(toy.play_one().await, "no warning before the end of the run");
        let progress = toy.client.status(pb::StatusRequest {}).await.expect("it lives");
        warning_text = progress.into_inner().warning;
    }
    assert!(warning_text.contains("Read-only file system"), "{warning_text}");
    disk.remount("rw");
    while toy.play_one().await {}
    let ended = served.end().await.expect("everything is written");
    assert_eq!(Left::behind(&ended, &out), expected);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn blocked_files_are_written_once_the_obstacle_is_gone() {
    let expected = calm(config(0)).await;
    let directory = tempfile::tempdir().expect("a directory");
    let out = directory.path();
    let in_the_way = ["checkpoint", "policy"].map(|name| out.join(name));
    in_the_way.iter().for_each(|path| std::fs::write(path, "").expect("writes"));
    let served = Served::start(impatient(out, false)).await;
    let mut toy = served.join("toy").await;
    let both = |warning_text: &str| {
        warning_text.contains("the checkpoint of round") && warning_text.contains("policy/best")
    };
    play_until_warned(&mut toy, both).await;
    in_the_way.iter().for_each(|path| std::fs::remove_file(path).expect("removes"));
    while toy.play_one().await {}
    let ended = served.end().await.expect("everything is written");
    assert_eq!(Left::behind(&ended, out), expected);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_learner_writes_nothing_to_a_replaced_run_directory() {
    let expected = calm(config(0)).await;
    let keep = tempfile::tempdir().expect("a directory");
    let (out, moved) = (keep.path().join("run"), keep.path().join("moved"));
    let served = Served::start(impatient(&out, false)).await;
    let mut toy = served.join("toy").await;
    play_to_the_first_checkpoint(&mut toy, &out).await;
    std::fs::rename(&out, &moved).expect("moves");
    std::fs::create_dir(&out).expect("creates");
    let warning_text =
        play_until_warned(&mut toy, |warning_text| warning_text.contains("checkpoint")).await;
    assert!(
        warning_text.contains("the run directory was moved, removed or replaced"),
        "{warning_text}"
    );
    std::fs::remove_dir(&out).expect("nothing was written there");
    std::fs::rename(&moved, &out).expect("moves back");
    while toy.play_one().await {}
    let ended = served.end().await.expect("everything is written");
    assert_eq!(Left::behind(&ended, &out), expected);
}
