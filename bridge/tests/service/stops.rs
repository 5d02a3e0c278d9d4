//! Motions that end early: the drives are stopped, and nothing moves before a reset.

use tandem_bridge::service::Error;
use tandem_bridge::{Command, Order, Settings};
use tandem_proto::pb;
use tokio::task::JoinHandle;
use tonic::{Code, Status};

use crate::service::rig::{Fault, Rig, UP_M, patient, request, slow, through};

/// Asserts that nothing moves and no motion starts before a reset, and that motions work after it.
async fn assert_stopped_until_reset(rig: &mut Rig, name: &str) {
    let is_stopped = |status: &pb::BridgeStatusResponse| status.phase() == pb::BridgePhase::Stopped;
    let status = rig.eventually(is_stopped).await;
    assert_eq!(status.stopped.unwrap().name, name);
    rig.assert_nothing_moves().await;
    let token = match rig.client.acquire(pb::AcquireRequest::default()).await {
        Ok(answer) => answer.into_inner().token,
        Err(status) => panic!("{status}"),
    };
    let refused = rig.execute(&token, slow()).await.err().unwrap();
    assert_eq!(refused.code(), Code::FailedPrecondition);
    assert!(refused.message().contains("not idle but Stopped"), "{refused}");
    rig.assert_nothing_moves().await;
    rig.reset(&token).await.unwrap();
    let mut playing = rig.execute(&token, through(&[UP_M], 1.0)).await.unwrap();
    let (last, _) = playing.last().await.unwrap();
    assert!(matches!(last.outcome.unwrap().outcome, Some(pb::motion_outcome::Outcome::Done(_))));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn nothing_moves_before_a_reset() {
    let mut rig = Rig::new(patient()).await;
    let status = rig.status().await;
    assert_eq!(status.stopped.unwrap().name, "not-reset");
    assert_stopped_until_reset(&mut rig, "not-reset").await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn any_client_stops_the_arms() {
    let mut rig = Rig::new(patient()).await;
    let token = rig.ready().await;
    let mut playing = rig.moving(&token).await;
    let n_stops = rig.tap.n_stops();
    let stopped = rig.stranger().await.stop(pb::StopRequest {}).await.unwrap().into_inner();
    assert!(rig.tap.n_stops() > n_stops, "the drives were stopped before the response");
    assert_eq!(rig.tap.newest(), Order::Stop);
    assert_eq!(stopped.stopped.unwrap().name, "requested");
    let why = playing.stopped().await;
    assert_eq!((why.name.as_str(), why.arm), ("requested", None));
    rig.client.release(pb::ReleaseRequest { token }).await.unwrap();
    assert_stopped_until_reset(&mut rig, "requested").await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn silent_arms_are_disconnected_and_confirm_no_stop() {
    let mut rig = Rig::new(patient()).await;
    let token = rig.ready().await;
    rig.tap.fail(Fault::Silent);
    let unconfirmed = rig.client.stop(pb::StopRequest {}).await.unwrap_err();
    assert_eq!(unconfirmed.code(), Code::Unavailable);
    assert!(unconfirmed.message().contains("have not confirmed it"), "{unconfirmed}");
    let status = rig.eventually(|status| status.arms.is_empty()).await;
    assert!(!status.at_rest, "their motion is unknown");
    let refused = rig.reset(&token).await.unwrap_err();
    assert!(refused.message().contains("not connected: no new state for 1 s"), "{refused}");
    rig.tap.fail(Fault::None);
    rig.eventually(|status| !status.arms.is_empty()).await;
    rig.client.stop(pb::StopRequest {}).await.unwrap();
    rig.reset(&token).await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stop_waits_in_no_queue() {
    let mut rig = Rig::new(patient()).await;
    let token = rig.ready().await;
    let mut playing = rig.moving(&token).await;
    rig.clock.hold();
    // More calls than the queue holds. None can be handled while no time passes.
    let flood: Vec<_> = (0..200)
        .map(|_| {
            let (mut client, token) = (rig.client.clone(), token.clone());
            tokio::spawn(async move { client.acquire(pb::AcquireRequest { token }).await })
        })
        .collect();
    // No time passes on the clock of the arms meanwhile.
    tokio::time::sleep(std::time::Duration::from_millis(500)).await;
    let mut other = rig.stranger().await;
    let stop = tokio::spawn(async move { other.stop(pb::StopRequest {}).await });
    tokio::time::sleep(std::time::Duration::from_millis(500)).await;
    let before_s = rig.status().await.now_s;
    rig.clock.free();
    let why = playing.stopped().await;
    assert_eq!(why.name, "requested");
    // 200 calls take 25 ticks; the stop took one of the first.
    assert!(why.when_s - before_s < 0.1, "after {} s", why.when_s - before_s);
    stop.await.unwrap().unwrap();
    for call in flood {
        drop(call.await.unwrap());
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stream_that_breaks_stops_the_arms() {
    let mut rig = Rig::new(patient()).await;
    let token = rig.ready().await;
    let playing = rig.moving(&token).await;
    drop(playing);
    assert_stopped_until_reset(&mut rig, "owner-left").await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_client_that_ends_its_signs_of_life_stops_the_arms_and_receives_the_outcome() {
    let mut rig = Rig::new(patient()).await;
    let token = rig.ready().await;
    let mut playing = rig.moving(&token).await;
    let (signs, _) = tokio::sync::mpsc::channel(1);
    playing.signs = signs;
    assert_eq!(playing.stopped().await.name, "owner-left");
    assert_stopped_until_reset(&mut rig, "owner-left").await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_second_start_on_one_stream_is_no_sign_of_life() {
    let mut rig = Rig::new(patient()).await;
    let token = rig.ready().await;
    let mut playing = rig.moving(&token).await;
    let start = pb::ExecuteStart { token, motion: Some(slow()), name: "slow".to_owned() };
    playing.signs.send(request(pb::execute_request::Request::Start(start))).await.unwrap();
    assert_eq!(playing.stopped().await.name, "owner-left");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_release_by_the_owner_stops_the_arms() {
    let mut rig = Rig::new(patient()).await;
    let token = rig.ready().await;
    let mut playing = rig.moving(&token).await;
    rig.client.release(pb::ReleaseRequest { token }).await.unwrap();
    assert_eq!(playing.stopped().await.name, "owner-left");
    assert_stopped_until_reset(&mut rig, "owner-left").await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_motion_of_a_silent_owner_pauses_and_is_then_stopped() {
    // Silence is measured on a clock that is faster than real time, so no keep-alive message is sent. The stream shows
    // the latest phase only, so each must last.
    let (owner_hold_s, owner_stop_s) = (30.0, 60.0);
    let settings = Settings { lease_s: 1e6, owner_hold_s, owner_stop_s, ..Settings::default() };
    let mut rig = Rig::new(settings).await;
    let token = rig.ready().await;
    let mut playing = rig.execute(&token, slow()).await.unwrap();
    let (last, phases) = playing.last().await.unwrap();
    use pb::BridgePhase::{Holding, Moving, Stopped};
    assert_eq!(phases, [Moving, Holding, Stopped]);
    let Some(pb::motion_outcome::Outcome::Stopped(why)) = last.outcome.unwrap().outcome else {
        panic!("a silent owner's motion does not end by itself")
    };
    assert_eq!(why.name, "owner-silent");
    assert!(why.got > Some(60.0) && why.allowed == Some(60.0) && why.unit == "s", "{why:?}");
    rig.client.release(pb::ReleaseRequest { token }).await.unwrap();
    rig.assert_nothing_moves().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn signs_of_life_keep_a_motion_going() {
    let settings = Settings { lease_s: 1e6, ..Settings::default() };
    let mut rig = Rig::new(settings).await;
    let token = rig.ready().await;
    rig.clock.hold();
    let (mut client, clock) = (rig.client.clone(), rig.clock.clone());
    let playing = tokio::spawn(async move {
        let (signs, requests) = tokio::sync::mpsc::channel(8);
        let start = pb::ExecuteStart { token, motion: Some(slow()), name: "slow".to_owned() };
        signs.send(request(pb::execute_request::Request::Start(start))).await.unwrap();
        let requests = tokio_stream::wrappers::ReceiverStream::new(requests);
        let responses = client.execute(requests).await.unwrap().into_inner();
        crate::service::rig::Playing { signs, responses }
    });
    while !playing.is_finished() {
        clock.pass(0.01);
        tokio::time::sleep(std::time::Duration::from_millis(2)).await;
    }
    let mut playing = playing.await.unwrap();
    // Three seconds of the arms' time; one second without keep-alive messages stops them.
    let since_s = rig.status().await.now_s;
    let mut now_s = since_s;
    while now_s < since_s + 3.0 {
        playing.alive().await;
        // A keep-alive message renews the lease. Until it has arrived, time passes in small steps.
        loop {
            clock.pass(0.01);
            let status = rig.status().await;
            assert_eq!(status.stopped, None, "{status:?}");
            now_s = status.now_s;
            if status.lease_left_s > 1e6 - 0.15 {
                break;
            }
        }
        for _ in 0..10 {
            clock.pass(0.01);
        }
    }
    clock.free();
    assert_eq!(playing.stopped().await.name, "owner-silent");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_shutdown_stops_the_arms_first() {
    let mut rig = Rig::new(patient()).await;
    let token = rig.ready().await;
    let mut playing = rig.moving(&token).await;
    let n_stops = rig.tap.n_stops();
    rig.shutdown.cancel();
    assert_eq!(playing.stopped().await.name, "shut-down");
    drop((playing, rig.client));
    rig.served.await.unwrap().unwrap();
    assert!(rig.tap.n_stops() > n_stops);
    assert_eq!(rig.tap.newest(), Order::Stop);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_shutdown_that_resting_arms_do_not_confirm_is_an_error() {
    for (fault, expected) in [
        (Fault::Silent, "the arms have not confirmed it within 1s"),
        (Fault::Dead, "could NOT be commanded to stop"),
        (Fault::Untrue, "the arms have confirmed the stop but are not known to rest after 1s"),
    ] {
        let mut rig = Rig::new(patient()).await;
        rig.ready().await;
        rig.tap.fail(fault);
        rig.shutdown.cancel();
        drop(rig.client);
        let error = rig.served.await.unwrap().unwrap_err().to_string();
        assert!(error.contains(expected) && error.contains("use the emergency stop"), "{error}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_driver_that_fails_stops_the_arms() {
    let mut rig = Rig::new(patient()).await;
    let token = rig.ready().await;
    let mut playing = rig.moving(&token).await;
    let n_stops = rig.tap.n_stops();
    rig.tap.fail(Fault::Exchange);
    let why = playing.stopped().await;
    assert_eq!(why.name, "driver");
    assert!(why.sentence.contains("the test pulled the plug"), "{why:?}");
    assert!(rig.tap.n_stops() > n_stops);
    // Silent arms cannot be reset.
    let refused = rig.client.reset(pb::ResetRequest { token: token.clone() }).await.unwrap_err();
    assert_eq!(refused.code(), Code::FailedPrecondition);
    rig.tap.fail(Fault::None);
    rig.client.release(pb::ReleaseRequest { token }).await.unwrap();
    assert_stopped_until_reset(&mut rig, "driver").await;
}

/// Stops the arms, lets them report that a joint turns, and begins a reset, which waits for them.
async fn begin_reset(rig: &mut Rig, token: &str) -> JoinHandle<Result<(), Status>> {
    rig.client.stop(pb::StopRequest {}).await.unwrap();
    rig.tap.fail(Fault::Restless);
    let since_s = rig.status().await.now_s;
    let is_later = |status: &pb::BridgeStatusResponse| status.now_s > since_s + 10.0;
    let before = rig.eventually(|status| is_later(status) && !status.at_rest).await;
    let (mut client, token) = (rig.client.clone(), token.to_owned());
    let reset = async move { client.reset(pb::ResetRequest { token }).await.map(|_| ()) };
    let resetting = tokio::spawn(reset);
    // The reset renews the lease.
    rig.eventually(|status| status.lease_left_s > before.lease_left_s).await;
    resetting
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_reset_waits_until_the_arms_rest() {
    let mut rig = Rig::new(patient()).await;
    let token = rig.ready().await;
    let resetting = begin_reset(&mut rig, &token).await;
    rig.tap.fail(Fault::None);
    resetting.await.unwrap().unwrap();
    rig.eventually(|status| status.phase() == pb::BridgePhase::Idle).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stop_while_a_reset_waits_is_not_reset() {
    let mut rig = Rig::new(patient()).await;
    let token = rig.ready().await;
    let resetting = begin_reset(&mut rig, &token).await;
    rig.stranger().await.stop(pb::StopRequest {}).await.unwrap();
    rig.tap.fail(Fault::None);
    let refused = resetting.await.unwrap().unwrap_err();
    assert_eq!(refused.code(), Code::FailedPrecondition);
    let expected = "stopped meanwhile (a client stopped the arms): inspect the arms";
    assert!(refused.message().contains(expected), "{refused}");
    rig.assert_nothing_moves().await;
    assert_eq!(rig.status().await.phase(), pb::BridgePhase::Stopped);
    rig.reset(&token).await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_fault_that_ends_while_a_reset_waits_is_not_reset() {
    let mut rig = Rig::new(patient()).await;
    let token = rig.ready().await;
    let resetting = begin_reset(&mut rig, &token).await;
    rig.tap.fail(Fault::Untrue);
    rig.eventually(|status| status.arms.is_empty()).await;
    rig.tap.fail(Fault::None);
    let refused = resetting.await.unwrap().unwrap_err();
    assert_eq!(refused.code(), Code::FailedPrecondition);
    assert!(refused.message().contains("a number of the state is not finite"), "{refused}");
    rig.assert_nothing_moves().await;
    assert_eq!(rig.status().await.phase(), pb::BridgePhase::Stopped);
    rig.reset(&token).await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_reset_reconnects_without_moving_the_arms() {
    let mut rig = Rig::dialling(patient()).await;
    let token = rig.ready().await;
    let mut playing = rig.moving(&token).await;
    rig.tap.fail(Fault::Dead);
    assert_eq!(playing.stopped().await.name, "driver");
    // The arms do not accept connections.
    let refused = rig.client.reset(pb::ResetRequest { token: token.clone() }).await.unwrap_err();
    assert_eq!(refused.code(), Code::Unavailable);
    assert!(refused.message().contains("not connected: no response"), "{refused}");

    rig.tap.fail(Fault::Lost);
    let since_s = rig.status().await.now_s;
    rig.eventually(|status| status.now_s > since_s + 1.0).await;
    assert_eq!(rig.tap.dialled().0, 0, "the service reconnects only on a reset");
    // A client that does not own the arms cannot reconnect them.
    let unknown = pb::ResetRequest { token: "0".repeat(32) };
    assert!(rig.client.reset(unknown).await.is_err());
    assert_eq!(rig.tap.dialled().0, 0);

    let before = rig.tap.angles();
    rig.reset(&token).await.unwrap();
    let first = Command { number: 1, order: Order::Stop };
    assert_eq!(rig.tap.dialled(), (1, Some(first)));
    let since_s = rig.status().await.now_s;
    let status = rig.eventually(|status| status.now_s > since_s + 1.0).await;
    assert_eq!(status.phase(), pb::BridgePhase::Idle);
    let moved = before.iter().zip(rig.tap.angles()).map(|(a, b)| a.largest_difference(&b));
    assert!(moved.fold(0.0, f64::max) < 1e-3, "{before:?} {:?}", rig.tap.angles());
    rig.moving(&token).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stop_that_fails_is_reported() {
    let mut rig = Rig::new(patient()).await;
    let token = rig.ready().await;
    let mut playing = rig.moving(&token).await;
    rig.tap.fail(Fault::Dead);
    assert_eq!(playing.stopped().await.name, "driver");
    let status = rig.client.stop(pb::StopRequest {}).await.unwrap_err();
    assert_eq!(status.code(), Code::Unavailable);
    assert!(status.message().contains("could NOT be commanded to stop"), "{status}");
    rig.tap.fail(Fault::None);
    rig.client.stop(pb::StopRequest {}).await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_driver_that_hangs_is_reported_and_blocks_no_client() {
    let mut rig = Rig::new(patient()).await;
    let token = rig.ready().await;
    let mut playing = rig.moving(&token).await;
    rig.tap.fail(Fault::Hang);
    let status = rig.client.stop(pb::StopRequest {}).await.unwrap_err();
    assert_eq!(status.code(), Code::Unavailable);
    assert!(status.message().contains("has not answered"), "{status}");
    assert_eq!(rig.status().await.phase(), pb::BridgePhase::Moving, "what was known last");
    rig.tap.fail(Fault::None);
    assert_eq!(playing.stopped().await.name, "requested");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_bug_in_a_driver_stops_the_drives_and_ends_the_service() {
    let mut rig = Rig::new(patient()).await;
    let token = rig.ready().await;
    let mut playing = rig.moving(&token).await;
    let n_stops = rig.tap.n_stops();
    rig.tap.fail(Fault::Panic);
    let status = playing.last().await.unwrap_err();
    assert_eq!(status.code(), Code::Unavailable, "{status}");
    drop((playing, rig.client));
    assert!(matches!(rig.served.await.unwrap(), Err(Error::Panicked)));
    assert!(rig.tap.n_stops() > n_stops, "the drives were stopped");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_oversleeping_thread_stops_the_arms() {
    let mut rig = Rig::new(patient()).await;
    let token = rig.ready().await;
    let mut playing = rig.moving(&token).await;
    // The pair's time stops meanwhile and its states become old too, but the late tick is detected first.
    rig.clock.oversleep(0.05);
    let why = playing.stopped().await;
    assert_eq!(why.name, "late");
    assert!(why.got > Some(0.045) && why.unit == "s", "{why:?}");
    rig.client.release(pb::ReleaseRequest { token }).await.unwrap();
    assert_stopped_until_reset(&mut rig, "late").await;
}
