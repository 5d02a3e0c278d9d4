//! Commands of the grippers during motions and at their ends.

use tandem_bridge::Phase;
use tandem_bridge::work_cell::mico_cell;
use tandem_core::ArmIndex;
use tandem_kinematics::{ArmSample, Joints, Motion};
use tandem_trials::SimulatedConfig;

use crate::pair::rig::Rig;

/// A motion of 0.3 s in which only the grippers move.
fn rest(opening: f64) -> Motion {
    let rests = |angles: &Joints| {
        let velocities = Joints::from_fn(angles.len(), |_| 0.0);
        vec![ArmSample { angles: *angles, velocities, gripper_opening: opening }; 31]
    };
    Motion { period_s: 0.01, arms: mico_cell().ready(0.05).unwrap().iter().map(rests).collect() }
}

#[test]
fn a_motion_ends_when_the_grippers_have_their_last_openings() {
    let mut rig = Rig::ready(&rest(0.5), SimulatedConfig::default());
    let from_s = rig.now_s;
    rig.play(rest(1.0), 1.0, |_| ());
    // The grippers need 0.6 s, twice as long as the motion.
    assert!((0.55..0.75).contains(&(rig.now_s - from_s)), "{} s", rig.now_s - from_s);
    let openings = rig.executor.openings().unwrap();
    assert!(openings.iter().all(|opening| (opening - 1.0).abs() < 1e-6), "{openings:?}");
    for _ in 0..50 {
        assert_eq!(rig.tick_owned(), Phase::Idle);
    }
    assert_eq!(rig.executor.openings(), Some(openings));
    for arm in 0..2 {
        let opening = rig.pair.borrow().opening(ArmIndex(arm));
        assert!((opening - 1.0).abs() < 0.02, "{opening}");
    }
}

#[test]
fn stopped_arms_have_no_commanded_openings() {
    let mut rig = Rig::ready(&rest(0.5), SimulatedConfig::default());
    let openings = rig.executor.openings().unwrap();
    assert!(openings.iter().all(|opening| (opening - 0.5).abs() < 0.02), "{openings:?}");
    rig.executor.stop(rig.now_s);
    assert_eq!(rig.executor.openings(), None);
}
