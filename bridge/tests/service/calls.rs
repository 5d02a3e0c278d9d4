//! The calls of the service.

use tandem_bridge::work_cell::mico_cell;
use tandem_kinematics::{ArmSample, ArmWaypoint, Joints, Motion, PlanSettings, plan};
use tandem_proto::pb;
use tonic::Code;

use crate::service::rig::{
    DEADLINE, Fault, READY_M, Rig, UP_M, joint_request, patient, slow, through,
};

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_arms_are_described() {
    let mut rig = Rig::bounded(patient(), 0.25).await;
    let response = rig.client.describe(pb::DescribeBridgeRequest {}).await.unwrap().into_inner();
    assert_eq!((response.driver.as_str(), response.arms.len()), ("sim", 2));
    for (arm, base_m) in response.arms.iter().zip([-0.39, 0.39]) {
        assert_eq!((arm.model.as_str(), arm.joints.len()), ("m1n4s200", 4));
        assert!((arm.base_in_world_m[0] - base_m).abs() < 1e-6, "{arm:?}");
        assert!(arm.joints.iter().all(|joint| joint.low_rad < joint.high_rad));
    }
    let limits = response.limits.unwrap();
    assert!((limits.speed - 0.25).abs() < 1e-12 && (limits.tool_speed_mps - 0.2).abs() < 1e-12);
    assert!((response.task_frame.unwrap().scale - 1.0).abs() < 1e-12);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_motion_ends_at_its_last_waypoint() {
    let mut rig = Rig::new(patient()).await;
    let token = rig.ready().await;
    let mut playing = rig.execute(&token, through(&[UP_M], 1.0)).await.unwrap();
    let (mut played_s, mut n_reports) = (0.0, 0);
    let last = loop {
        let response = playing.next().await.unwrap();
        let progress = response.progress.clone().unwrap();
        assert!(progress.played_s >= played_s, "{progress:?}");
        (played_s, n_reports) = (progress.played_s, n_reports + 1);
        playing.alive().await;
        if response.outcome.is_some() {
            break response;
        }
        let [arm, _] = &progress.arms[..] else { panic!("{progress:?}") };
        let apart = arm.angles_rad.iter().zip(&arm.reference_rad).map(|(a, b)| (a - b).abs());
        assert!(apart.fold(0.0, f64::max) < 2.0_f64.to_radians(), "{arm:?}");
    };
    assert!(n_reports > 5, "{n_reports} reports");
    let outcome = last.outcome.unwrap().outcome;
    assert_eq!(outcome, Some(pb::motion_outcome::Outcome::Done(pb::MotionDone {})));
    let progress = last.progress.unwrap();
    assert!((progress.played_s - progress.duration_s).abs() < 1e-9);
    for (arm, goal_m) in progress.arms.iter().zip(UP_M) {
        for (at_m, goal_m) in arm.tool_in_world_m.iter().zip(goal_m) {
            assert!((at_m - goal_m).abs() < 0.003, "{arm:?}");
        }
        assert!((arm.opening - 0.8).abs() < 0.1, "{arm:?}");
    }
    assert_eq!(rig.status().await.phase(), pb::BridgePhase::Idle);
    let again = rig.execute(&token, through(&[READY_M], 1.0)).await.unwrap().last().await.unwrap();
    assert!(matches!(again.0.outcome.unwrap().outcome, Some(pb::motion_outcome::Outcome::Done(_))));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_motion_of_joints_is_played() {
    let mut rig = Rig::new(patient()).await;
    let token = rig.ready().await;
    let cell = mico_cell();
    let at = |arms_m: [[f64; 3]; 2]| {
        arms_m
            .map(|at_m| ArmWaypoint { tool_in_world_m: at_m.into(), gripper_opening: 0.5 })
            .to_vec()
    };
    let start = cell.ready(0.05).unwrap();
    let way = [at(READY_M), at(UP_M)];
    let motion = plan(&cell, &way, &start, &PlanSettings::default()).unwrap().sampled(100.0);
    rig.execute(&token, joint_request(&motion)).await.unwrap().last().await.unwrap();
    for (arm, angles) in rig.tap.angles().iter().enumerate() {
        let end = motion.arms[arm][motion.arms[arm].len() - 1].angles;
        assert!(end.largest_difference(angles) < 0.3_f64.to_radians(), "{angles:?}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn no_motion_is_faster_than_the_bound() {
    let mut rig = Rig::bounded(patient(), 0.25).await;
    let token = rig.ready().await;
    for (wanted, expected) in [(1.0, 0.25), (0.125, 0.125)] {
        let since_s = rig.status().await.now_s;
        let goal = if wanted > 0.5 { UP_M } else { READY_M };
        let mut playing = rig.execute(&token, through(&[goal], wanted)).await.unwrap();
        let progress = playing.last().await.unwrap().0.progress.unwrap();
        assert!((progress.speed - expected).abs() < 1e-12, "{progress:?}");
        let took_s = rig.status().await.now_s - since_s;
        assert!(took_s > progress.duration_s / expected, "{took_s} s, {progress:?}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_check_returns_the_fault_and_moves_nothing() {
    use pb::check_response::Verdict;
    let mut rig = Rig::new(patient()).await;
    let check = |motion| pb::CheckRequest { motion: Some(motion) };
    // A check does not require a reset.
    rig.eventually(|status| !status.arms.is_empty()).await;
    let before = rig.tap.angles();
    let verdict = async |rig: &mut Rig, motion| {
        rig.client.check(check(motion)).await.unwrap().into_inner().verdict.unwrap()
    };
    match verdict(&mut rig, through(&[UP_M, READY_M], 0.5)).await {
        Verdict::Accepted(accepted) => {
            assert!(accepted.duration_s > 0.2, "{accepted:?}");
            assert!(accepted.arms_gap_m > 0.02 && accepted.table_gap_m.len() == 2);
            assert!(accepted.table_gap_m.iter().all(|gap_m| (0.004..0.1).contains(gap_m)));
            assert!(accepted.self_gap_m.iter().all(|gap_m| (0.005..0.2).contains(gap_m)));
            assert_eq!(accepted.self_gap_m.len(), 2);
        }
        refused @ Verdict::Refused(_) => panic!("{refused:?}"),
    }
    let refused = |verdict| match verdict {
        Verdict::Refused(refused) => refused,
        accepted @ Verdict::Accepted(_) => panic!("{accepted:?}"),
    };
    let low = refused(verdict(&mut rig, through(&[[[-0.12, 0.0, 0.02], READY_M[1]]], 1.0)).await);
    assert_eq!((low.name.as_str(), low.arm), ("table-gap", Some(0)), "{low:?}");
    assert!(low.got < low.allowed && low.unit == "m" && low.when_s > Some(0.1), "{low:?}");
    assert!(low.sentence.contains("mm above the table"), "{low:?}");
    let far = refused(
        verdict(
            &mut rig,
            through(
                &[[[-0.12, 0.24, 0.095], [0.12, 0.0, 0.30]], [READY_M[0], [0.35, 0.02, 0.4]]],
                1.0,
            ),
        )
        .await,
    );
    assert!(far.arm.is_some() && !far.sentence.is_empty(), "{far:?}");
    let wide = refused(verdict(&mut rig, through(&[[[-0.12, 0.4, 0.095], READY_M[1]]], 1.0)).await);
    assert_eq!((wide.name.as_str(), wide.way_point), ("step", Some(0)), "{wide:?}");
    let close = refused(
        verdict(&mut rig, through(&[[[-0.01, 0.0, 0.095], [0.01, 0.0, 0.095]]], 1.0)).await,
    );
    assert_eq!(close.name, "arms-gap", "{close:?}");
    assert_eq!(rig.tap.angles(), before);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_check_waits_for_the_next_state_after_an_invalid_one() {
    let mut rig = Rig::new(patient()).await;
    rig.eventually(|status| !status.arms.is_empty()).await;
    rig.tap.fail(Fault::Untrue);
    rig.eventually(|status| status.arms.is_empty()).await;
    let request = pb::CheckRequest { motion: Some(through(&[UP_M], 1.0)) };
    let unknown = rig.client.check(request.clone()).await.unwrap_err();
    assert_eq!(unknown.code(), Code::FailedPrecondition, "{unknown}");
    assert!(unknown.message().contains("position of the arms is not known"), "{unknown}");

    let mut other = rig.stranger().await;
    let checking = tokio::spawn(async move { other.check(request).await });
    tokio::time::sleep(std::time::Duration::from_millis(500)).await;
    rig.tap.fail(Fault::None);
    let verdict = checking.await.unwrap().unwrap().into_inner().verdict.unwrap();
    assert!(matches!(verdict, pb::check_response::Verdict::Accepted(_)), "{verdict:?}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_motion_into_the_arms_own_base_is_refused_by_name() {
    let mut rig = Rig::new(patient()).await;
    let token = rig.ready().await;
    let ready = mico_cell().ready(0.05).unwrap();
    // The tool goes back to 0.11 m from the base, and the fingers turn towards it.
    let way_deg = [0.0, -11.3, 27.0, 90.3];
    let sample = |arm: usize, idx: u32| {
        let (u, moves) = (f64::from(idx) / 600.0, if arm == 0 { 1.0 } else { 0.0 });
        let s = u * u * u * (10.0 + u * (6.0 * u - 15.0)) * moves;
        let rate = 30.0 * u * u * (1.0 - u) * (1.0 - u) / 6.0 * moves;
        let way = way_deg.map(f64::to_radians);
        let velocities = Joints::from_fn(4, |joint| rate * way[joint]);
        let angles = Joints::from_fn(4, |joint| ready[arm][joint] + s * way[joint]);
        ArmSample { angles, velocities, gripper_opening: 1.0 }
    };
    let samples = |arm| (0..=600).map(|idx| sample(arm, idx)).collect();
    let motion = joint_request(&Motion { period_s: 0.01, arms: vec![samples(0), samples(1)] });
    let request = pb::CheckRequest { motion: Some(motion.clone()) };
    let verdict = rig.client.check(request).await.unwrap().into_inner().verdict.unwrap();
    let pb::check_response::Verdict::Refused(refused) = verdict else { panic!("{verdict:?}") };
    assert_eq!((refused.name.as_str(), refused.arm), ("self-gap", Some(0)), "{refused:?}");
    assert!(refused.got < refused.allowed && refused.unit == "m", "{refused:?}");
    assert!(refused.sentence.contains("from the arm's own base"), "{refused:?}");
    let before = rig.tap.angles();
    let refused = rig.execute(&token, motion).await.err().unwrap();
    assert_eq!(refused.code(), Code::FailedPrecondition);
    assert!(refused.message().contains("from the arm's own base"), "{refused}");
    let moved = before.iter().zip(rig.tap.angles()).map(|(a, b)| a.largest_difference(&b));
    assert!(moved.fold(0.0, f64::max) < 1e-3);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_check_of_a_long_motion_does_not_delay_ticks() {
    let mut rig = Rig::new(patient()).await;
    rig.eventually(|status| !status.arms.is_empty()).await;
    // No tick is possible: a check that needed one would wait forever.
    rig.clock.hold();
    let long = through(&[UP_M, READY_M].repeat(200), 1.0);
    let checking = rig.client.check(pb::CheckRequest { motion: Some(long) });
    let checked = tokio::time::timeout(DEADLINE, checking).await.unwrap().unwrap().into_inner();
    let Some(pb::check_response::Verdict::Accepted(accepted)) = checked.verdict else {
        panic!("{checked:?}")
    };
    assert!(accepted.duration_s > 60.0, "{accepted:?}");
    rig.clock.free();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_refused_motion_is_not_played() {
    let mut rig = Rig::new(patient()).await;
    let token = rig.ready().await;
    let before = rig.tap.angles();
    let low = through(&[[[-0.12, 0.0, 0.02], READY_M[1]]], 1.0);
    let refused = rig.execute(&token, low).await.err().unwrap();
    assert_eq!(refused.code(), Code::FailedPrecondition);
    assert!(refused.message().contains("mm above the table"), "{refused}");
    let mut elsewhere = through(&[UP_M, READY_M], 1.0);
    if let Some(pb::motion_request::Motion::WayPoints(way)) = &mut elsewhere.motion {
        way.from_here = false;
    }
    let refused = rig.execute(&token, elsewhere).await.err().unwrap();
    assert_eq!(refused.code(), Code::FailedPrecondition);
    assert!(refused.message().contains("from the start of the motion"), "{refused}");
    assert_eq!(rig.status().await.phase(), pb::BridgePhase::Idle);
    let moved = before.iter().zip(rig.tap.angles()).map(|(a, b)| a.largest_difference(&b));
    assert!(moved.fold(0.0, f64::max) < 1e-3);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_arms_have_one_owner_at_a_time() {
    let settings = tandem_bridge::Settings { lease_s: 60.0, ..patient() };
    let settings = tandem_bridge::Settings { owner_hold_s: 30.0, owner_stop_s: 60.0, ..settings };
    let mut rig = Rig::new(settings).await;
    let mut other = rig.stranger().await;
    rig.eventually(|status| !status.arms.is_empty()).await;
    let token = rig.acquire().await;
    rig.clock.hold();
    assert!(token.len() == 32 && token.bytes().all(|byte| byte.is_ascii_hexdigit()), "{token}");
    rig.clock.free();
    // Renews the lease, in case the machine is slow.
    rig.client.acquire(pb::AcquireRequest { token: token.clone() }).await.unwrap();
    let denied = other.acquire(pb::AcquireRequest::default()).await.unwrap_err();
    assert_eq!(denied.code(), Code::PermissionDenied);
    assert!(denied.message().contains("owned by another client"), "{denied}");
    let forged = "0123456789abcdef0123456789abcdef".to_owned();
    let denied = other.reset(pb::ResetRequest { token: forged.clone() }).await.unwrap_err();
    assert_eq!(denied.code(), Code::PermissionDenied);
    let denied = other.acquire(pb::AcquireRequest { token: forged.clone() }).await.unwrap_err();
    assert_eq!(denied.code(), Code::PermissionDenied);
    let denied = rig.execute(&forged, slow()).await.err().unwrap();
    assert_eq!(denied.code(), Code::PermissionDenied);
    let status = rig.status().await;
    assert!(status.is_owned && status.lease_left_s > 0.0 && status.lease_left_s <= 60.0);

    // A silent owner loses its lease, and an expired lease cannot be renewed.
    rig.eventually(|status| !status.is_owned).await;
    let gone = rig.client.acquire(pb::AcquireRequest { token: token.clone() }).await.unwrap_err();
    assert_eq!(gone.code(), Code::FailedPrecondition);
    let gone = rig.execute(&token, slow()).await.err().unwrap();
    assert_eq!(gone.code(), Code::FailedPrecondition);
    let theirs = other.acquire(pb::AcquireRequest::default()).await.unwrap().into_inner();
    assert_ne!(theirs.token, token);
    other.release(pb::ReleaseRequest { token: theirs.token }).await.unwrap();
    assert_ne!(rig.acquire().await, token);
}
