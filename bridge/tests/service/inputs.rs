//! Malformed requests are refused by the name of the field and move nothing.

use tandem_proto::pb;
use tonic::Code;

use crate::service::rig::{READY_M, Rig, UP_M, patient, through};

/// A modification of a valid request.
fn way(spoil: impl FnOnce(&mut pb::WayPoints)) -> pb::MotionRequest {
    let mut request = through(&[UP_M, READY_M], 1.0);
    if let Some(pb::motion_request::Motion::WayPoints(way)) = &mut request.motion {
        spoil(way);
    }
    request
}

fn speed(speed: f64) -> pb::MotionRequest {
    through(&[UP_M], speed)
}

fn joints(spoil: impl FnOnce(&mut pb::JointMotion)) -> pb::MotionRequest {
    let sample =
        pb::JointSample { angles_rad: vec![0.0; 4], velocities_radps: vec![0.0; 4], opening: 0.5 };
    let arm = pb::ArmMotion { samples: vec![sample; 3] };
    let mut motion = pb::JointMotion { period_s: 0.01, arms: vec![arm; 2] };
    spoil(&mut motion);
    pb::MotionRequest { motion: Some(pb::motion_request::Motion::JointMotion(motion)), speed: 1.0 }
}

fn ways() -> Vec<(pb::MotionRequest, &'static str)> {
    vec![
        (speed(0.0), "motion.speed: expected more than 0 and at most 1, got 0"),
        (speed(1.5), "motion.speed: expected more than 0 and at most 1, got 1.5"),
        (speed(f64::NAN), "motion.speed: expected more than 0 and at most 1, got NaN"),
        (speed(f64::INFINITY), "motion.speed: "),
        (
            pb::MotionRequest { motion: None, speed: 1.0 },
            "motion.motion: expected way_points or joint_motion, got none",
        ),
        (
            way(|way| way.way_points.clear()),
            "motion.way_points.way_points: expected 1 to 999, got 0",
        ),
        (
            way(|way| way.way_points = vec![way.way_points[0].clone(); 1000]),
            "motion.way_points.way_points: expected 1 to 999, got 1000",
        ),
        (
            way(|way| {
                way.from_here = false;
                way.way_points.truncate(1);
            }),
            "motion.way_points.way_points: expected 2 to 1000, got 1",
        ),
        (way(|way| way.step_s = 0.0), "motion.way_points.step_s: "),
        (way(|way| way.step_s = f64::NAN), "motion.way_points.step_s: "),
        (
            way(|way| way.way_points[1].arms.truncate(1)),
            "motion.way_points.way_points[1].arms: expected 2 arms, got 1 arms",
        ),
        (
            way(|way| way.way_points[0].arms[1].tool_in_world_m.truncate(2)),
            "motion.way_points.way_points[0].arms[1].tool_in_world_m: expected 3 numbers, got 2 numbers",
        ),
        (
            way(|way| way.way_points[0].arms[0].tool_in_world_m[2] = f64::NAN),
            "motion.way_points.way_points[0].arms[0].tool_in_world_m[2]: expected a finite number, got NaN",
        ),
        (
            way(|way| way.way_points[1].arms[0].tool_in_world_m[0] = f64::NEG_INFINITY),
            "motion.way_points.way_points[1].arms[0].tool_in_world_m[0]: expected a finite number, got -inf",
        ),
        (
            way(|way| way.way_points[1].arms[1].opening = -0.1),
            "motion.way_points.way_points[1].arms[1].opening: expected a number in [0, 1], got -0.1",
        ),
        (way(|way| way.way_points[1].arms[1].opening = f64::NAN), "arms[1].opening: "),
    ]
}

fn motions_of_joints() -> Vec<(pb::MotionRequest, &'static str)> {
    vec![
        (joints(|joints| joints.period_s = 1.0), "motion.joint_motion.period_s: "),
        (joints(|joints| joints.arms.truncate(1)), "motion.joint_motion.arms: expected 2 arms"),
        (
            joints(|joints| joints.arms[0].samples.clear()),
            "motion.joint_motion.arms[0].samples: expected 2 to 60001, got 0",
        ),
        (
            joints(|joints| joints.arms[1].samples.truncate(2)),
            "motion.joint_motion.arms[1].samples: expected 3, as the first arm has, got 2",
        ),
        (
            joints(|joints| joints.arms[1].samples[2].angles_rad = vec![0.0; 6]),
            "motion.joint_motion.arms[1].samples[2].angles_rad: expected 4 numbers, got 6 numbers",
        ),
        (
            joints(|joints| joints.arms[0].samples[1].velocities_radps[3] = f64::INFINITY),
            "motion.joint_motion.arms[0].samples[1].velocities_radps[3]: expected a finite number, got inf",
        ),
        (joints(|joints| joints.arms[0].samples[1].opening = 1.1), "samples[1].opening: "),
    ]
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn malformed_fields_are_refused_by_name() {
    let mut rig = Rig::new(patient()).await;
    let token = rig.ready().await;
    let before = rig.tap.angles();
    for (motion, expected) in ways().into_iter().chain(motions_of_joints()) {
        let request = pb::CheckRequest { motion: Some(motion.clone()) };
        let refused = rig.client.check(request).await.unwrap_err();
        assert_eq!(refused.code(), Code::InvalidArgument, "{expected}: {refused}");
        assert!(refused.message().contains(expected), "{expected}: {refused}");
        let refused = rig.execute(&token, motion).await.err().unwrap();
        assert_eq!(refused.code(), Code::InvalidArgument, "{expected}: {refused}");
        assert!(refused.message().contains(expected) && refused.message().starts_with("start."));
    }
    let refused = rig.client.check(pb::CheckRequest { motion: None }).await.unwrap_err();
    assert_eq!(refused.message(), "motion: expected a message, got none");
    assert_eq!(rig.status().await.phase(), pb::BridgePhase::Idle);
    let moved = before.iter().zip(rig.tap.angles()).map(|(a, b)| a.largest_difference(&b));
    assert!(moved.fold(0.0, f64::max) < 1e-3);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_malformed_token_is_refused_and_not_repeated() {
    let mut rig = Rig::new(patient()).await;
    let long = "f".repeat(33);
    for token in
        ["me", "0123456789abcdef0123456789abcdeg", "+123456789abcdef0123456789abcdef", &long]
    {
        let token = token.to_owned();
        let refused =
            rig.client.acquire(pb::AcquireRequest { token: token.clone() }).await.unwrap_err();
        assert_eq!(refused.code(), Code::InvalidArgument);
        assert!(!refused.message().contains(&token), "{refused}");
        let refused =
            rig.client.reset(pb::ResetRequest { token: token.clone() }).await.unwrap_err();
        assert_eq!(refused.code(), Code::InvalidArgument);
        let refused = rig.client.release(pb::ReleaseRequest { token }).await.unwrap_err();
        assert_eq!(refused.code(), Code::InvalidArgument);
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stream_starts_with_a_start_message() {
    let mut rig = Rig::new(patient()).await;
    let alive = pb::ExecuteRequest {
        request: Some(pb::execute_request::Request::Alive(pb::SignOfLife {})),
    };
    for (requests, code) in [
        (vec![alive], Code::InvalidArgument),
        (vec![pb::ExecuteRequest { request: None }], Code::InvalidArgument),
        (vec![], Code::Cancelled),
    ] {
        let refused = rig.client.execute(tokio_stream::iter(requests)).await.err().unwrap();
        assert_eq!(refused.code(), code, "{refused}");
    }
}
