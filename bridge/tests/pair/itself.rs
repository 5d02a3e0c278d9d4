//! Arms that are commanded, pushed or driven into themselves.

use std::cell::RefCell;

use tandem_bridge::work_cell::mico_cell;
use tandem_bridge::{ArmCommand, Command, Driver as _, Order, Phase, StartError, StopCause};
use tandem_core::ArmIndex;
use tandem_kinematics::{ArmSample, Joints, Motion, Reason};
use tandem_trials::simulated::{Disturbance, PERIOD_S};
use tandem_trials::{SimulatedConfig, SimulatedPair};

use crate::pair::rig::{OWNER, Rig};

/// The turns of the joints from the ready position until the gripper is 14 mm inside the arm's own base, degrees.
const WAY_DEG: [f64; 4] = [0.0, -11.3, 27.0, 90.3];
const DURATION_S: f64 = 6.0;
const OPENING: f64 = 0.5;

/// Moves the first arm along a share of the path into its own base, from rest to rest; the other one rests.
fn on_way(share: f64) -> Motion {
    let ready = mico_cell().ready(0.05).unwrap();
    let way = |joint: usize| share * WAY_DEG[joint].to_radians();
    let sample = |arm: usize, u: f64| {
        let s = u * u * u * (10.0 + u * (6.0 * u - 15.0));
        let rate = 30.0 * u * u * (1.0 - u) * (1.0 - u) / DURATION_S;
        let moves = if arm == 0 { 1.0 } else { 0.0 };
        ArmSample {
            angles: Joints::from_fn(4, |joint| ready[arm][joint] + moves * s * way(joint)),
            velocities: Joints::from_fn(4, |joint| moves * rate * way(joint)),
            gripper_opening: OPENING,
        }
    };
    let n = (DURATION_S / PERIOD_S).round();
    let samples = |arm| (0..=600_u32).map(|idx| sample(arm, f64::from(idx) / n)).collect();
    Motion { period_s: PERIOD_S, arms: vec![samples(0), samples(1)] }
}

/// The largest share of the path at whose end the arm keeps `gap_m` to itself.
fn share_with(gap_m: f64) -> f64 {
    let cell = mico_cell();
    let keeps = |share: &f64| {
        let ends = on_way(*share).arms.into_iter().map(|samples| samples[600].angles);
        cell.gaps_with(&ends.collect::<Vec<_>>(), &[OPENING; 2]).self_m[0] >= gap_m
    };
    (0..1000).map(|idx| f64::from(idx) / 1000.0).take_while(keeps).last().unwrap()
}

#[test]
fn a_motion_of_the_gripper_into_its_own_base_is_refused() {
    let motion = on_way(1.0);
    let mut rig = Rig::ready(&motion, SimulatedConfig::default());
    let before = rig.angles();
    let error = rig.executor.start(OWNER, motion, 1.0, rig.now_s).unwrap_err();
    let StartError::Refused(refusal) = &error else { panic!("{error}") };
    assert!(matches!(refusal.reason, Reason::SelfGap(["base", "gripper"], _)), "{refusal}");
    assert_eq!((refusal.arm, rig.tick_owned()), (ArmIndex(0), Phase::Idle));
    assert_eq!(rig.angles(), before);
    // A motion that keeps the smallest allowed gap is played to its end.
    let near = on_way(share_with(0.0055));
    rig.play(near, 1.0, |rig| {
        assert!(rig.pair.borrow().gaps().self_m[0] > 0.002);
    });
}

#[test]
fn an_arm_that_drifts_towards_itself_is_stopped_before_contact() {
    for (joint, sign) in [(1, -1.0), (2, 1.0), (3, 1.0)] {
        let near = on_way(share_with(0.0055));
        let mut rig = Rig::ready(&near, SimulatedConfig::default());
        rig.executor.start(OWNER, near, 1.0, rig.now_s).unwrap();
        let least_m = RefCell::new(f64::INFINITY);
        let tick = |rig: &mut Rig| {
            let phase = rig.tick_owned();
            let pair = rig.pair.borrow();
            assert!(!pair.touches_itself(ArmIndex(0)), "joint {joint}");
            let mut least_m = least_m.borrow_mut();
            *least_m = least_m.min(pair.gaps().self_m[0]);
            phase
        };
        for _ in 0..500 {
            assert_ne!(tick(&mut rig), Phase::Stopped);
        }
        let drift = |arm| {
            let radps = move |idx| if (arm, idx) == (0, joint) { sign * 0.2 } else { 0.0 };
            Joints::from_fn(4, radps)
        };
        let drift_radps = vec![drift(0), drift(1)];
        rig.pair.borrow_mut().disturb(Disturbance { drift_radps, ..Disturbance::default() });
        let stops = (0..2000).any(|_| tick(&mut rig) == Phase::Stopped);
        assert!(stops, "joint {joint}");
        let cause = rig.executor.stopped_by().unwrap().cause.clone();
        let expected = matches!(cause, StopCause::SelfGap(_) | StopCause::Tracking(_));
        assert!(expected, "joint {joint}: {cause}");
        for _ in 0..20 {
            tick(&mut rig);
        }
        assert!(*least_m.borrow() > 0.0, "joint {joint}: {least_m:?}");
    }
}

#[test]
fn an_arm_driven_into_itself_stalls_and_reports_a_contact() {
    let at: Vec<Joints> = on_way(0.5).arms.iter().map(|samples| samples[600].angles).collect();
    let mut pair = SimulatedPair::new(mico_cell(), &at, OPENING, SimulatedConfig::default());
    let into = Joints::from_fn(4, |joint| WAY_DEG[joint].to_radians() / DURATION_S);
    let stay = Joints::new(&[0.0; 4]);
    let mut reported = None;
    for number in 1..=400 {
        let arms = [into, stay].map(|velocities| ArmCommand { velocities, opening: OPENING });
        let state = pair.exchange(&Command { number, order: Order::Move(arms.to_vec()) }).unwrap();
        let gap_m = pair.gaps().self_m[0];
        assert!(gap_m > -1e-4, "{number}: {gap_m} m");
        assert!(!state.arms[1].faults.contact, "{number}");
        assert_eq!(state.arms[0].faults.contact, pair.touches_itself(ArmIndex(0)));
        if state.arms[0].faults.contact {
            reported.get_or_insert(gap_m);
        }
    }
    assert!(reported.is_some_and(|gap_m| gap_m < 0.001), "{reported:?}");
}
