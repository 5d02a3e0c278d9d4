//! Ownership, phases and timing.

use std::rc::Rc;

use tandem_bridge::work_cell::mico_cell;
use tandem_bridge::{
    Executor, LeaseError, Phase, ResetError, Settings, StartError, StopCause, Token,
};
use tandem_core::ArmIndex;
use tandem_kinematics::Reason;
use tandem_trials::SimulatedConfig;

use crate::pair::injection::{Kind, Tap};
use crate::pair::rig::{OWNER, Rig, TASKS, walk};

const STRANGER: Token = Token(5);

fn config() -> SimulatedConfig {
    SimulatedConfig::default()
}

#[test]
fn nothing_moves_before_a_reset_by_the_owner() {
    let motion = walk(TASKS, 1, 3);
    let mut rig = Rig::new(&motion, config());
    let at = rig.angles();
    let start = |rig: &mut Rig| rig.executor.start(OWNER, motion.clone(), 1.0, rig.now_s);
    assert_eq!(start(&mut rig), Err(StartError::Lease(LeaseError::NotOwned)));
    rig.executor.acquire(OWNER, rig.now_s).unwrap();
    assert_eq!(start(&mut rig), Err(StartError::NotIdle(Phase::Stopped)));
    let reset = rig.executor.reset(OWNER, rig.now_s);
    assert_eq!(reset, Err(ResetError::States { got: 0, rejected: None }));
    for _ in 0..20 {
        assert_eq!(rig.tick(), Phase::Stopped);
    }
    assert_eq!(rig.executor.stopped_by().unwrap().cause, StopCause::NotReset);
    rig.executor.reset(OWNER, rig.now_s).unwrap();
    for _ in 0..20 {
        assert_eq!(rig.tick(), Phase::Idle);
    }
    assert_eq!(rig.angles(), at);
}

#[test]
fn only_the_owner_starts_and_any_client_stops() {
    let motion = walk(TASKS, 2, 3);
    let mut rig = Rig::ready(&motion, config());
    let held = |result| matches!(result, Err(LeaseError::Held { .. }));
    assert!(held(rig.executor.acquire(STRANGER, rig.now_s)));
    assert!(held(rig.executor.release(STRANGER, rig.now_s)));
    let start = rig.executor.start(STRANGER, motion.clone(), 1.0, rig.now_s);
    assert!(matches!(start, Err(StartError::Lease(LeaseError::Held { .. }))));
    rig.executor.start(OWNER, motion.clone(), 1.0, rig.now_s).unwrap();
    for _ in 0..30 {
        assert_eq!(rig.tick_owned(), Phase::Moving);
    }
    let again = rig.executor.start(OWNER, motion, 1.0, rig.now_s);
    assert_eq!(again, Err(StartError::NotIdle(Phase::Moving)));
    rig.executor.stop(rig.now_s);
    for _ in 0..20 {
        assert_eq!(rig.tick_owned(), Phase::Stopped);
    }
    assert!(rig.executor.at_rest());
    let reset = rig.executor.reset(STRANGER, rig.now_s);
    assert!(matches!(reset, Err(ResetError::Lease(_))));
    rig.executor.reset(OWNER, rig.now_s).unwrap();
    // The motion no longer begins at the position of the arms.
    let motion = walk(TASKS, 2, 3);
    let refused = rig.executor.start(OWNER, motion, 1.0, rig.now_s);
    let refusal = refused.unwrap_err();
    assert!(
        matches!(&refusal, StartError::Refused(refusal) if matches!(refusal.reason, Reason::Start(..))),
        "{refusal}"
    );
    assert_eq!(rig.tick(), Phase::Idle);
}

#[test]
fn a_release_stops_the_motion_and_a_lease_expires() {
    let motion = walk(TASKS, 3, 3);
    let mut rig = Rig::ready(&motion, config());
    rig.executor.start(OWNER, motion, 1.0, rig.now_s).unwrap();
    rig.tick_owned();
    rig.executor.release(OWNER, rig.now_s).unwrap();
    assert_eq!(rig.executor.stopped_by().unwrap().cause, StopCause::OwnerReleased);
    rig.executor.acquire(STRANGER, rig.now_s).unwrap();
    for _ in 0..510 {
        rig.tick();
    }
    rig.executor.acquire(OWNER, rig.now_s).unwrap();
    assert!(rig.executor.acquire(STRANGER, rig.now_s).is_err());
}

#[test]
fn a_motion_pauses_for_a_late_owner_and_resumes() {
    let motion = walk(TASKS, 4, 3);
    let end = [0, 1].map(|arm: usize| motion.arms[arm][motion.arms[arm].len() - 1].angles);
    let mut rig = Rig::ready(&motion, config());
    rig.executor.start(OWNER, motion, 1.0, rig.now_s).unwrap();
    for _ in 0..20 {
        rig.tick_owned();
    }
    let phases: Vec<Phase> = (0..60).map(|_| rig.tick()).collect();
    assert_eq!(phases[25], Phase::Moving);
    assert_eq!(phases[50], Phase::Holding);
    let (at, progress) = (rig.angles(), rig.executor.progress());
    for _ in 0..20 {
        assert_eq!(rig.tick(), Phase::Holding);
    }
    assert_eq!(rig.executor.progress(), progress, "a motion on hold does not go on");
    for (at, now) in at.iter().zip(rig.angles()) {
        assert!(at.largest_difference(&now) < 1e-3, "{at:?} {now:?}");
    }
    while rig.tick_owned() != Phase::Idle {
        assert!(rig.executor.stopped_by().is_none(), "{:?}", rig.executor.stopped_by());
    }
    for (end, at) in end.iter().zip(rig.angles()) {
        assert!(end.largest_difference(&at) < 0.3_f64.to_radians());
    }
}

#[test]
fn a_motion_survives_a_short_silence_of_the_arms() {
    let motion = walk(TASKS, 5, 3);
    let mut rig = Rig::ready(&motion, config());
    rig.executor.start(OWNER, motion, 1.0, rig.now_s).unwrap();
    for _ in 0..40 {
        assert_eq!(rig.tick_owned(), Phase::Moving);
    }
    rig.injection.borrow_mut().begin(Kind::StateLost, ArmIndex(0), 0);
    let phases = [(); 3].map(|()| rig.tick_owned());
    assert_eq!(phases, [Phase::Moving, Phase::Moving, Phase::Holding]);
    rig.injection.borrow_mut().end();
    while rig.tick_owned() != Phase::Idle {
        assert!(rig.executor.stopped_by().is_none(), "{:?}", rig.executor.stopped_by());
    }
}

#[test]
fn a_motion_at_half_speed_takes_twice_as_long() {
    let motion = walk(TASKS, 6, 3);
    let mut rig = Rig::ready(&motion, config());
    for speed in [0.0, -1.0, 1.01, f64::NAN] {
        let refused = rig.executor.start(OWNER, motion.clone(), speed, rig.now_s);
        assert!(matches!(refused, Err(StartError::Speed(_))));
    }
    let (from_s, duration_s) = (rig.now_s, motion.duration_s());
    rig.play(motion, 0.5, |_| {});
    let took_s = rig.now_s - from_s;
    assert!((0.0..0.3).contains(&(took_s - 2.0 * duration_s)), "{took_s} {duration_s}");
}

#[test]
fn a_late_tick_stops_the_arms() {
    for (pause_s, late) in [(0.044, false), (0.046, true), (0.0, true), (-1.0, true)] {
        let motion = walk(TASKS, 7, 3);
        let mut rig = Rig::ready(&motion, config());
        rig.executor.start(OWNER, motion, 1.0, rig.now_s).unwrap();
        rig.tick_owned();
        rig.now_s += pause_s;
        rig.executor.tick(rig.now_s);
        let cause = rig.executor.stopped_by().map(|stop| stop.cause.clone());
        assert_eq!(matches!(cause, Some(StopCause::TickLate(_))), late, "{pause_s}: {cause:?}");
    }
}

#[test]
fn inconsistent_settings_are_refused() {
    let check = |settings: Settings, name: &str| {
        let motion = walk(TASKS, 1, 2);
        let at = [0, 1].map(|arm: usize| motion.arms[arm][0].angles);
        let pair = tandem_trials::SimulatedPair::new(mico_cell(), &at, 0.0, config());
        let refused = Executor::new(mico_cell(), pair, settings).unwrap_err();
        assert_eq!(refused.name, name, "{refused}");
    };
    let default = Settings::default();
    check(Settings { tracking_rad: f64::NAN, ..default }, "tracking_rad");
    check(Settings { torque_nm: 0.0, ..default }, "torque_nm");
    check(Settings { gain_per_s: 50.0, ..default }, "gain_per_s");
    check(Settings { arms_gap_m: 0.03, ..default }, "arms_gap_m");
    check(Settings { self_gap_m: 0.006, ..default }, "self_gap_m");
    check(Settings { brake_s: 1.0, ..default }, "brake_s");
    check(Settings { lease_s: 0.5, ..default }, "lease_s");
}

#[test]
fn a_checked_motion_starts_only_with_its_executor_and_position() {
    let motion = walk(TASKS, 6, 3);
    let mut rig = Rig::ready(&motion, config());
    let at: Vec<_> = motion.arms.iter().map(|samples| samples[0].angles).collect();
    let checked = |rig: &Rig| rig.executor.checker().check(motion.clone(), &at).unwrap();
    let of_another = checked(&Rig::new(&motion, config()));
    let refused = rig.executor.start_checked(OWNER, of_another, 1.0, rig.now_s);
    assert_eq!(refused, Err(StartError::OtherChecker));
    let refused = rig.executor.start_checked(STRANGER, checked(&rig), 1.0, rig.now_s);
    assert!(matches!(refused, Err(StartError::Lease(LeaseError::Held { .. }))));

    let again = checked(&rig);
    let started = rig.executor.start_checked(OWNER, checked(&rig), 1.0, rig.now_s);
    assert_eq!(started, Ok(()));
    while rig.tick_owned() != Phase::Idle {
        assert!(rig.executor.stopped_by().is_none(), "{:?}", rig.executor.stopped_by());
    }
    // The motion passed its check at an earlier position of the arms.
    let refused = rig.executor.start_checked(OWNER, again, 1.0, rig.now_s);
    assert!(
        matches!(&refused, Err(StartError::Refused(refusal)) if matches!(refusal.reason, Reason::Start(..))),
        "{refused:?}"
    );
    assert_eq!(rig.tick(), Phase::Idle);
}

#[test]
fn only_its_owner_renews_a_lease_which_reports_its_remaining_time() {
    let motion = walk(TASKS, 7, 3);
    let mut rig = Rig::new(&motion, config());
    assert_eq!(rig.executor.renew(OWNER, rig.now_s), Err(LeaseError::NotOwned));
    assert_eq!(rig.executor.lease_left_s(rig.now_s), None);
    rig.executor.acquire(OWNER, rig.now_s).unwrap();
    rig.now_s += 3.0;
    assert!(matches!(rig.executor.renew(STRANGER, rig.now_s), Err(LeaseError::Held { .. })));
    assert!((rig.executor.lease_left_s(rig.now_s).unwrap() - 2.0).abs() < 1e-9);
    rig.executor.renew(OWNER, rig.now_s).unwrap();
    assert!((rig.executor.lease_left_s(rig.now_s).unwrap() - 5.0).abs() < 1e-9);
    rig.now_s += 5.0;
    assert_eq!(rig.executor.renew(OWNER, rig.now_s), Err(LeaseError::NotOwned));
    assert_eq!(rig.executor.lease_left_s(rig.now_s), None);
}

#[test]
fn a_reset_is_refused_where_the_arms_would_be_stopped_again() {
    let motion = walk(TASKS, 8, 3);
    let mut rig = Rig::new(&motion, config());
    let mut cell = mico_cell();
    cell.table_z_m += 0.5;
    let tap = Tap::new(Rc::clone(&rig.pair), Rc::clone(&rig.injection));
    rig.executor = Executor::new(cell, tap, Settings::default()).unwrap();
    rig.executor.acquire(OWNER, rig.now_s).unwrap();
    for _ in 0..15 {
        rig.tick();
    }
    let reset = rig.executor.reset(OWNER, rig.now_s);
    let Err(ResetError::Limit { arm: Some(_), cause: StopCause::TableGap(_) }) = reset else {
        panic!("{reset:?}");
    };
    assert_eq!(rig.tick(), Phase::Stopped);
    assert_eq!(rig.executor.stopped_by().unwrap().cause, StopCause::NotReset, "not stopped again");
}

#[test]
fn an_owner_may_reset_idle_arms_and_not_moving_ones() {
    let motion = walk(TASKS, 1, 3);
    let mut rig = Rig::ready(&motion, config());
    rig.executor.reset(OWNER, rig.now_s).unwrap();
    assert_eq!(rig.tick(), Phase::Idle);
    let reset = rig.executor.reset(STRANGER, rig.now_s);
    assert!(matches!(reset, Err(ResetError::Lease(LeaseError::Held { .. }))), "{reset:?}");
    rig.executor.start(OWNER, motion, 1.0, rig.now_s).unwrap();
    assert_eq!(rig.tick_owned(), Phase::Moving);
    let reset = rig.executor.reset(OWNER, rig.now_s);
    assert_eq!(reset, Err(ResetError::NotStopped(Phase::Moving)));
    assert_eq!(rig.tick_owned(), Phase::Moving);
}

#[test]
fn a_reset_after_a_driver_failure_is_refused() {
    let motion = walk(TASKS, 8, 3);
    let mut rig = Rig::ready(&motion, config());
    rig.injection.borrow_mut().begin(Kind::DriverError, ArmIndex(0), 0);
    assert_eq!(rig.tick(), Phase::Stopped);
    let reset = rig.executor.reset(OWNER, rig.now_s);
    assert!(matches!(reset, Err(ResetError::Driver(_))), "what was seen last is not old yet");
}
