//! Faults that a client injects into simulated arms: each leads to its stop, until it is cleared.

use tandem_proto::pb::{self, InjectedFault as F};
use tonic::{Code, Status};

use crate::service::rig::{Rig, UP_M, patient, slow, through};

const ARM: u32 = 1;
const JOINT: u32 = 1;

async fn inject(rig: &mut Rig, fault: F) -> Result<Vec<pb::FaultInjection>, Status> {
    inject_at(rig, fault, ARM, JOINT).await
}

async fn inject_at(
    rig: &mut Rig,
    fault: F,
    arm: u32,
    joint: u32,
) -> Result<Vec<pb::FaultInjection>, Status> {
    let fault = pb::FaultInjection { fault: fault.into(), arm, joint };
    let action = Some(pb::inject_request::Action::Fault(fault));
    let response = rig.client.inject(pb::InjectRequest { action }).await?;
    Ok(response.into_inner().injected)
}

async fn clear(rig: &mut Rig) {
    let action = Some(pb::inject_request::Action::Clear(pb::ClearFaults {}));
    let response = rig.client.inject(pb::InjectRequest { action }).await.unwrap();
    assert_eq!(response.into_inner().injected, []);
}

/// Injects `fault` into arms that move, or hold their position, and asserts that they stop for `name` at the arm and
/// joint, that `Status` shows why, that a check still answers unless states are late, and that a reset succeeds only after
/// the fault is cleared.
async fn drill(fault: F, moving: bool, name: &str, place: [Option<u32>; 2]) {
    let mut rig = Rig::new(patient()).await;
    let token = rig.ready().await;
    let playing = if moving { Some(rig.moving(&token).await) } else { None };
    let injected = inject(&mut rig, fault).await.unwrap();
    let expected = pb::FaultInjection { fault: fault.into(), arm: ARM, joint: JOINT };
    assert_eq!(injected, [expected]);
    let stop = match playing {
        Some(mut playing) => playing.stopped().await,
        None => {
            // The first status may be older than the reset.
            let has_stopped = |status: &pb::BridgeStatusResponse| {
                status.stopped.as_ref().is_some_and(|stop| stop.name != "not-reset")
            };
            rig.eventually(has_stopped).await.stopped.unwrap()
        }
    };
    assert_eq!((stop.name.as_str(), [stop.arm, stop.joint]), (name, place), "{}", stop.sentence);
    if fault != F::LateStates {
        let motion = Some(through(&[UP_M], 1.0));
        rig.client.check(pb::CheckRequest { motion }).await.unwrap();
        let status = rig.status().await;
        let arm = &status.arms[1];
        let reported = [arm.emergency_stop, arm.drive_fault, arm.contact];
        assert_eq!(reported, [F::EmergencyStop, F::DriveFault, F::Contact].map(|it| it == fault));
        assert_eq!(status.injected, [expected]);
    }
    rig.assert_nothing_moves().await;
    let lasts = !matches!(fault, F::BlockedJoint | F::Drift);
    if lasts {
        let reset = rig.client.reset(pb::ResetRequest { token: token.clone() }).await;
        let expected = match fault {
            F::EmergencyStop => "arm 1: the emergency stop is pressed",
            F::DriveFault => "arm 1: a drive reports a fault",
            F::Contact => "arm 1: a contact is reported",
            F::Torque => "arm 1: an unexplained torque of ",
            _ => "the newest has a fault: ",
        };
        let refused = reset.unwrap_err();
        assert!(refused.message().contains(expected), "{refused}");
    }
    clear(&mut rig).await;
    rig.reset(&token).await.unwrap();
    let mut playing = rig.execute(&token, through(&[UP_M], 1.0)).await.unwrap();
    let (last, _) = playing.last().await.unwrap();
    assert!(matches!(last.outcome.unwrap().outcome, Some(pb::motion_outcome::Outcome::Done(_))));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_emergency_stop_stops_the_arms() {
    drill(F::EmergencyStop, true, "emergency-stop", [Some(ARM), None]).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_drive_fault_stops_the_arms() {
    drill(F::DriveFault, true, "drive-fault", [Some(ARM), None]).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_contact_stops_arms_that_hold_their_position() {
    drill(F::Contact, false, "contact", [Some(ARM), None]).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_blocked_joint_stops_the_arms() {
    drill(F::BlockedJoint, true, "torque", [Some(ARM), Some(JOINT)]).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_torque_stops_arms_that_hold_their_position() {
    drill(F::Torque, false, "torque", [Some(ARM), Some(JOINT)]).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_drift_stops_the_arms() {
    drill(F::Drift, true, "tracking", [Some(ARM), Some(JOINT)]).await;
    drill(F::Drift, false, "tracking", [Some(ARM), Some(JOINT)]).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn late_states_stop_the_arms() {
    drill(F::LateStates, true, "state-stale", [None, None]).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn real_arms_and_unknown_places_are_refused() {
    let mut real = Rig::dialling(patient()).await;
    let refused = inject(&mut real, F::Contact).await.unwrap_err();
    assert_eq!(refused.code(), Code::FailedPrecondition);
    assert!(refused.message().contains("simulated arms only"), "{refused}");
    assert_eq!(real.status().await.injected, []);

    let mut rig = Rig::new(patient()).await;
    let token = rig.ready().await;
    for (fault, arm, joint, expected) in [
        (F::Contact, 2, 0, "fault.arm: expected an index below 2, got 2"),
        (F::Torque, 0, 4, "fault.joint: expected an index below 4, got 4"),
        (F::Unspecified, 0, 0, "fault.fault: expected an injected fault, got 0"),
    ] {
        let refused = inject_at(&mut rig, fault, arm, joint).await.unwrap_err();
        assert_eq!((refused.code(), refused.message()), (Code::InvalidArgument, expected));
    }
    let empty = rig.client.inject(pb::InjectRequest::default()).await.unwrap_err();
    assert_eq!(empty.code(), Code::InvalidArgument);
    let mut playing = rig.execute(&token, slow()).await.unwrap();
    playing.next().await.unwrap();
    assert_eq!(rig.status().await.stopped, None);
}
