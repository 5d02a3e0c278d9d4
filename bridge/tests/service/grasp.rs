//! Motions from the present positions of arms that hold something.

use glam::DVec3;
use tandem_bridge::work_cell::mico_cell;
use tandem_proto::pb;
use tandem_trials::simulated::Block;

use crate::service::rig::{Rig, patient};

/// The height of the tool above the table at a block, metres.
const WORK_M: f64 = 0.050;

/// A motion from the present positions through tools at these heights above the blocks' places (base frames, metres),
/// with these openings.
fn above_blocks(heights: &[(f64, f64)], speed: f64) -> pb::MotionRequest {
    let arm = |arm: usize, height_m: f64, opening: f64| {
        let world_from_base = mico_cell().arms[arm].world_from_base();
        let at = world_from_base.transform_point(&place(height_m).into());
        pb::ArmWayPoint { tool_in_world_m: vec![at.x, at.y, at.z], opening }
    };
    let waypoint = |(height_m, opening): &(f64, f64)| pb::BridgeWayPoint {
        arms: vec![arm(0, *height_m, *opening), arm(1, *height_m, *opening)],
    };
    let way_points = heights.iter().map(waypoint).collect();
    let waypoints = pb::WayPoints { way_points, step_s: 0.04, from_here: true };
    pb::MotionRequest { motion: Some(pb::motion_request::Motion::WayPoints(waypoints)), speed }
}

/// The point at this height above a block's place; base frame, metres.
fn place(height_m: f64) -> DVec3 {
    DVec3::new(0.26, -0.03, height_m)
}

async fn carry_out(rig: &mut Rig, token: &str, motion: pb::MotionRequest) {
    let (last, _) = rig.execute(token, motion).await.unwrap().last().await.unwrap();
    let outcome = last.outcome.unwrap().outcome.unwrap();
    assert_eq!(outcome, pb::motion_outcome::Outcome::Done(pb::MotionDone {}));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_motion_from_here_keeps_hold_of_a_block() {
    let cell = mico_cell();
    let block = |arm: usize| {
        let world_from_base = cell.arms[arm].world_from_base();
        let at = DVec3::from(world_from_base.transform_point(&place(0.0).into())).as_vec3();
        Block::small([at.x, at.y])
    };
    let mut rig = Rig::with_blocks(patient(), vec![block(0), block(1)]).await;
    let token = rig.ready().await;
    let grasp = above_blocks(&[(0.16, 1.0), (WORK_M, 1.0), (WORK_M, 0.0)], 1.0);
    carry_out(&mut rig, &token, grasp).await;
    let table = rig.tap.held();
    assert!(table.iter().all(|(opening, _)| (0.4..0.5).contains(opening)), "{table:?}");
    rig.tap.take_widest();
    for n in 1..=3 {
        let lifted_m = 0.03 * f64::from(n);
        carry_out(&mut rig, &token, above_blocks(&[(WORK_M + lifted_m, 0.0)], 0.15)).await;
        assert!(rig.tap.take_widest() < 1e-9, "the grippers were told to open");
        for ((_, before_m), (opening, at_m)) in table.iter().zip(rig.tap.held()) {
            let got_m = at_m - before_m;
            assert!((got_m - lifted_m).abs() < 0.01, "lifted by {got_m} m of {lifted_m} m");
            assert!((0.4..0.5).contains(&opening), "{opening}");
        }
    }
}
