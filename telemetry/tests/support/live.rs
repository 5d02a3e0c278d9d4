//! Logs played to a client of the websocket protocol.

use std::net::{SocketAddr, TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use foxglove::Decode as _;
use foxglove::messages::SceneUpdate;
use foxglove::messages::scene_entity_deletion::Type;
use serde_json::{Value, json};
use tandem_core::{Layout, Task, TaskSpec};
use tandem_telemetry::live::{Clock, Follower, LiveArms, Replay};
use tandem_telemetry::{EpisodeMetadata, EpisodeRecorder, Error};
use tungstenite::{ClientRequestBuilder, Message, WebSocket};

use crate::episode_log_tests::{motion, synthetic};

const SUBPROTOCOL: &str = "foxglove.sdk.v1";
/// Longest wait for a message.
const TIMEOUT: Duration = Duration::from_secs(20);

/// A clock that shows what was set.
#[derive(Default)]
struct ManualClock(Arc<AtomicU64>);

impl ManualClock {
    fn clock(&self) -> Clock {
        let millis = Arc::clone(&self.0);
        Arc::new(move || Duration::from_millis(millis.load(Ordering::Relaxed)))
    }

    fn set(&self, millis: u64) {
        self.0.store(millis, Ordering::Relaxed);
    }
}

/// A viewer.
struct Viewer {
    socket: WebSocket<TcpStream>,
    /// The channel of each subscription.
    subscriptions: Vec<(u32, u64)>,
}

/// A message that a viewer receives.
#[derive(Debug)]
enum Received {
    Text(Value),
    /// Subscription, time and payload.
    Data(u32, u64, Vec<u8>),
    /// Status, position and whether it was sought.
    State(u8, u64, bool),
    Time(u64),
}

impl Viewer {
    fn connect(address: SocketAddr) -> Self {
        let stream = TcpStream::connect(address).unwrap();
        stream.set_read_timeout(Some(TIMEOUT)).unwrap();
        let uri = format!("ws://{address}").parse().unwrap();
        let request = ClientRequestBuilder::new(uri).with_sub_protocol(SUBPROTOCOL);
        let (socket, _) = tungstenite::client(request, stream).unwrap();
        Self { socket, subscriptions: Vec::new() }
    }

    fn receive(&mut self) -> Received {
        loop {
            match self.socket.read().unwrap() {
                Message::Text(text) => {
                    let text: Value = serde_json::from_str(&text).unwrap();
                    self.repeat_refused(&text);
                    return Received::Text(text);
                }
                Message::Binary(bytes) => {
                    let number =
                        |at: usize| u64::from_le_bytes(bytes[at..at + 8].try_into().unwrap());
                    let id = || u32::from_le_bytes(bytes[1..5].try_into().unwrap());
                    return match bytes[0] {
                        1 => Received::Data(id(), number(5), bytes[13..].to_vec()),
                        2 => Received::Time(number(1)),
                        5 => Received::State(bytes[1], number(2), bytes[14] != 0),
                        _ => continue,
                    };
                }
                _ => {}
            }
        }
    }

    /// Returns the next message for which `choose` returns a value.
    fn wait_for<T>(&mut self, mut choose: impl FnMut(Received) -> Option<T>) -> T {
        loop {
            if let Some(chosen) = choose(self.receive()) {
                return chosen;
            }
        }
    }

    /// Returns the server's information and the number of the channel of each of `topics`.
    fn channels<const N: usize>(&mut self, topics: [&str; N]) -> (Value, [u64; N]) {
        let (mut info, mut ids) = (Value::Null, [None; N]);
        while ids.contains(&None) {
            let Received::Text(text) = self.receive() else { continue };
            for channel in text["channels"].as_array().into_iter().flatten() {
                if let Some(idx) = topics.iter().position(|topic| channel["topic"] == *topic) {
                    ids[idx] = channel["id"].as_u64();
                }
            }
            if text["op"] == "serverInfo" {
                info = text;
            }
        }
        (info, ids.map(Option::unwrap))
    }

    /// Subscribes again if the server does not know the channel yet: it knows a channel a moment after it has advertised
    /// it.
    fn repeat_refused(&mut self, text: &Value) {
        let message = text["message"].as_str().unwrap_or_default();
        let unknown = message.strip_prefix("Unknown channel ID: ");
        let Some(unknown) = unknown.and_then(|id| id.parse::<u64>().ok()) else { return };
        let refused = self.subscriptions.iter().position(|(_, channel)| *channel == unknown);
        if let Some(idx) = refused {
            let (subscription, channel) = self.subscriptions.swap_remove(idx);
            self.subscribe(subscription, channel);
        }
    }

    fn subscribe(&mut self, subscription: u32, channel: u64) {
        self.subscriptions.push((subscription, channel));
        let subscriptions = [json!({ "id": subscription, "channelId": channel })];
        let request = json!({ "op": "subscribe", "subscriptions": subscriptions });
        self.socket.send(Message::text(request.to_string())).unwrap();
    }

    fn control(&mut self, play: bool, speed: f32, seek_ns: Option<u64>) {
        let id = b"request";
        let mut request = vec![3, u8::from(!play)];
        request.extend(speed.to_le_bytes());
        request.push(u8::from(seek_ns.is_some()));
        request.extend(seek_ns.unwrap_or(0).to_le_bytes());
        request.extend(u32::try_from(id.len()).unwrap().to_le_bytes());
        request.extend(id);
        self.socket.send(Message::binary(request)).unwrap();
    }
}

/// Writes two logs of 2 s.
fn logs(directory: &Path) -> Vec<PathBuf> {
    let names = ["eval-000001-000.mcap", "eval-000001-001.mcap"];
    names.map(|name| synthetic::write_log(&directory.join(name)).unwrap()).to_vec()
}

/// Writes a log of 2 s with one arm.
fn write_one_arm_log(path: &Path) -> PathBuf {
    let task = TaskSpec::from(Layout::new(Task::Push, 1));
    let mut scene = synthetic::scene(0.0);
    scene.arms.truncate(1);
    scene.objects.truncate(1);
    scene.goals.truncate(1);
    let mut step = synthetic::transitions_of(&task).remove(0);
    (step.rewards_per_arm, step.advice, step.advised_arms) = (vec![-1.0], Vec::new(), 0);
    step.budget_left = None;
    let metadata = EpisodeMetadata { task: task.clone(), ..synthetic::metadata() };
    let mut recorder = EpisodeRecorder::create(path, &metadata).unwrap();
    recorder.record_step(&scene, &synthetic::record(0, &step)).unwrap();
    scene.time_s = 2.0;
    recorder.record_outcome(&scene, &vec![0.25; task.n_observation()]).unwrap();
    recorder.finish().unwrap()
}

fn any_port() -> SocketAddr {
    "127.0.0.1:0".parse().unwrap()
}

/// Runs `play` on a thread until `view` returns.
fn while_playing(play: impl FnOnce(&dyn Fn() -> bool) + Send, view: impl FnOnce()) {
    let stop = AtomicBool::new(false);
    std::thread::scope(|scope| {
        scope.spawn(|| play(&|| stop.load(Ordering::Relaxed)));
        let outcome = std::panic::catch_unwind(std::panic::AssertUnwindSafe(view));
        stop.store(true, Ordering::Relaxed);
        if let Err(panic) = outcome {
            std::panic::resume_unwind(panic);
        }
    });
}

#[test]
fn a_viewer_seeks_a_replay_and_gets_the_messages_of_that_time() {
    let directory = tempfile::tempdir().unwrap();
    let clock = ManualClock::default();
    let replay = Replay::start(any_port(), &logs(directory.path()), clock.clock()).unwrap();
    let address = replay.address();
    while_playing(
        |stop| replay.run(stop).unwrap(),
        || {
            let mut viewer = Viewer::connect(address);
            let topics =
                ["/transition", "/scene", "/stats", "/outcome", "/tf", "/joint_states", "/log"];
            let (info, [transition, scene, ..]) = viewer.channels(topics);
            let capabilities = info["capabilities"].as_array().unwrap();
            assert!(capabilities.contains(&json!("playbackControl")), "{info}");
            // Two logs of 2 s, and a pause of 0.5 s.
            assert_eq!(info["dataEndTime"], json!({ "sec": 4, "nsec": 500_000_000 }), "{info}");

            viewer.subscribe(7, transition);
            let first = viewer.wait_for(|message| match message {
                Received::Data(7, time_ns, _) => Some(time_ns),
                _ => None,
            });
            assert_eq!(first, 0, "the present state, although the clock stands still");

            viewer.subscribe(8, scene);
            // Step 30 of the second log, 1.2 s after its start at 2.5 s, with 0.04 s per step.
            let (step_ns, sought_ns) = (3_700_000_000_u64, 3_710_000_000);
            viewer.control(false, 1.0, Some(sought_ns));
            let (mut state, mut step, mut stamp_ns) = (None, None, None);
            viewer.wait_for(|message| {
                match message {
                    Received::State(status, position_ns, true) => {
                        state = Some((status, position_ns));
                    }
                    Received::Data(7, time_ns, data) if time_ns == sought_ns => {
                        // Field 1, the number of the step, as a varint below 128.
                        assert_eq!(data[0], 8);
                        step = Some(data[1]);
                    }
                    Received::Data(8, time_ns, data) if time_ns == sought_ns => {
                        let update = SceneUpdate::decode(data.as_slice()).unwrap();
                        stamp_ns = update.entities[0].timestamp.map(|stamp| stamp.total_nanos());
                    }
                    _ => {}
                }
                state.zip(step).zip(stamp_ns)
            });
            assert_eq!(state, Some((1, sought_ns)), "paused there");
            assert_eq!(step, Some(30));
            assert!(stamp_ns.is_some_and(|ns| ns.abs_diff(step_ns) < 1_000_000), "{stamp_ns:?}");

            viewer.control(true, 2.0, None);
            viewer.wait_for(|message| matches!(message, Received::State(0, ..)).then_some(()));
            clock.set(100);
            let next = viewer.wait_for(|message| match message {
                Received::Data(7, time_ns, _) if time_ns > sought_ns => Some(time_ns),
                _ => None,
            });
            assert!(next.abs_diff(3_740_000_000) < 1_000_000, "the following step: {next}");
            clock.set(60_000);
            viewer.wait_for(|message| {
                matches!(message, Received::State(3, 4_500_000_000, _)).then_some(())
            });
        },
    );
}

#[test]
fn the_first_scene_of_a_log_and_of_a_sought_time_deletes_all_others() {
    let directory = tempfile::tempdir().unwrap();
    let path = |name: &str| directory.path().join(name);
    let two_arms = synthetic::write_log(&path("eval-000001-000.mcap")).unwrap();
    let paths = [two_arms, write_one_arm_log(&path("eval-000001-001.mcap"))];
    let clock = ManualClock::default();
    let replay = Replay::start(any_port(), &paths, clock.clock()).unwrap();
    let address = replay.address();
    while_playing(
        |stop| replay.run(stop).unwrap(),
        || {
            let mut viewer = Viewer::connect(address);
            let (_, [scene]) = viewer.channels(["/scene"]);
            viewer.subscribe(1, scene);
            // The number of arms that a scene shows, and the number of times that it deletes all others.
            let next = |viewer: &mut Viewer| {
                viewer.wait_for(|message| {
                    let Received::Data(1, time_ns, data) = message else { return None };
                    let update = SceneUpdate::decode(data.as_slice()).unwrap();
                    assert!(update.deletions.iter().all(|it| it.r#type() == Type::All));
                    let is_arm = |id: &str| id.starts_with("arm");
                    let n_arms = update.entities.iter().filter(|it| is_arm(&it.id)).count();
                    Some((time_ns, n_arms, update.deletions.len()))
                })
            };
            assert_eq!(next(&mut viewer), (0, 2, 1), "the present state");
            clock.set(2_600);
            let mut shown = next(&mut viewer);
            while shown.0 < 2_500_000_000 {
                assert_eq!(shown.1, 2, "at {} ns", shown.0);
                shown = next(&mut viewer);
            }
            assert_eq!((shown.1, shown.2), (1, 1), "the first scene of the second log");
            viewer.control(false, 1.0, Some(1_000_000_000));
            while shown.0 != 1_000_000_000 {
                shown = next(&mut viewer);
            }
            assert_eq!((shown.1, shown.2), (2, 1), "the scene of the sought time");
        },
    );
}

#[test]
fn a_replay_continues_without_logs_that_are_damaged_or_were_deleted() {
    let directory = tempfile::tempdir().unwrap();
    let mut paths = vec![directory.path().join("eval-000000-000.mcap")];
    std::fs::write(&paths[0], "no log").unwrap();
    let clock = ManualClock::default();
    assert!(Replay::start(any_port(), &paths, clock.clock()).is_err(), "nothing to play");
    paths.extend(logs(directory.path()));
    let replay = Replay::start(any_port(), &paths, clock.clock()).unwrap();
    std::fs::remove_file(&paths[1]).unwrap();
    let address = replay.address();
    while_playing(
        |stop| replay.run(stop).unwrap(),
        || {
            let mut viewer = Viewer::connect(address);
            let (info, [transition]) = viewer.channels(["/transition"]);
            assert_eq!(info["dataEndTime"], json!({ "sec": 4, "nsec": 500_000_000 }), "{info}");
            viewer.subscribe(1, transition);
            clock.set(60_000);
            let time_ns = viewer.wait_for(|message| match message {
                Received::Data(1, time_ns, _) => Some(time_ns),
                _ => None,
            });
            assert!(time_ns >= 2_500_000_000, "a message of the last log: {time_ns}");
        },
    );
}

#[test]
fn a_follower_plays_only_logs_that_are_new() {
    let directory = tempfile::tempdir().unwrap();
    logs(directory.path());
    let clock = ManualClock::default();
    let mcap = directory.path().to_owned();
    let follower = Follower::start(any_port(), mcap.clone(), clock.clock()).unwrap();
    let address = follower.address();
    while_playing(
        |stop| follower.run(stop),
        || {
            let mut viewer = Viewer::connect(address);
            synthetic::write_log(&mcap.join("eval-000002-000.mcap")).unwrap();
            let mut millis = 1_000;
            clock.set(millis);
            let (info, [transition]) = viewer.channels(["/transition"]);
            assert_eq!(info["dataEndTime"], Value::Null, "the end is open");
            viewer.subscribe(1, transition);
            let mut latest_ns = 0;
            let time_ns = viewer.wait_for(|message| match message {
                Received::Data(1, time_ns, _) => Some(time_ns),
                Received::Time(time_ns) => {
                    assert!(time_ns >= latest_ns, "time runs backwards: {time_ns}");
                    latest_ns = time_ns;
                    millis += 20;
                    clock.set(millis);
                    None
                }
                _ => None,
            });
            assert!(time_ns <= 2_000_000_000, "one episode of 2 s: {time_ns}");

            clock.set(millis + 60_000);
            let mut late = Viewer::connect(address);
            let (_, [transition]) = late.channels(["/transition"]);
            late.subscribe(2, transition);
            // States that are still being sent when the viewer subscribes may come before the last one.
            let last_ns = late.wait_for(|message| match message {
                Received::Data(2, time_ns @ 2_000_000_000, _) => Some(time_ns),
                _ => None,
            });

            // A resumed run evaluates a policy again.
            synthetic::write_log(&mcap.join("eval-000002-000.mcap")).unwrap();
            clock.set(millis + 120_000);
            late.wait_for(|message| match message {
                Received::Data(2, time_ns, _) => (time_ns > last_ns).then_some(()),
                _ => None,
            });
        },
    );
}

#[test]
fn an_address_in_use_is_named() {
    let directory = tempfile::tempdir().unwrap();
    let occupied = TcpListener::bind(any_port()).unwrap();
    let address = occupied.local_addr().unwrap();
    let clock = ManualClock::default().clock();
    let error = Replay::start(address, &logs(directory.path()), clock).err().unwrap();
    assert!(matches!(&error, Error::Listen { address: named, .. } if *named == address));
    let line = format!("cannot listen on {address} for viewers: choose another address for --live");
    assert_eq!(error.to_string(), line);
}

#[test]
fn a_viewer_sees_the_arms_of_a_bridge_as_they_are() {
    let mut live = LiveArms::start(any_port(), 2).unwrap();
    let mut viewer = Viewer::connect(live.address());
    let (_, [scene, arms]) = viewer.channels(["/scene", "/arms"]);
    viewer.subscribe(1, scene);
    viewer.subscribe(2, arms);
    let is_stopped = AtomicBool::new(false);
    std::thread::scope(|scope| {
        scope.spawn(|| {
            let mut step = 0;
            while !is_stopped.load(Ordering::Relaxed) {
                live.publish(&motion::moving(step));
                step += 1;
                std::thread::sleep(Duration::from_millis(5));
            }
        });
        let data = |subscription: u32| {
            move |received| match received {
                Received::Data(id, at_ns, payload) if id == subscription => Some((at_ns, payload)),
                _ => None,
            }
        };
        let (at_ns, payload) = viewer.wait_for(data(1));
        let shown = SceneUpdate::decode(payload.as_slice()).unwrap();
        assert_eq!(shown.entities[0].timestamp.unwrap().total_nanos(), at_ns);
        assert!(shown.entities.iter().any(|entity| entity.id == "arm1"));
        let (later_ns, _) = viewer.wait_for(data(2));
        assert!(later_ns >= at_ns);
        is_stopped.store(true, Ordering::Relaxed);
    });
    live.stop();
}
