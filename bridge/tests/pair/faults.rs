//! After any fault the arms come to rest within their limits and stay there.

use std::collections::BTreeMap;

use glam::DVec3;
use tandem_bridge::work_cell::mico_cell;
use tandem_bridge::{Phase, StartError, StopCause};
use tandem_core::rng::{index, uniform};
use tandem_core::{ArmIndex, Stream, episode_rng};
use tandem_kinematics::{ForwardKinematics, Joints, Motion};
use tandem_trials::SimulatedConfig;
use tandem_trials::simulated::PERIOD_S;

use crate::pair::injection::{KINDS, Kind, disturbance};
use crate::pair::observer::{Observer, Slack};
use crate::pair::rig::{LOW, MIDDLE, OWNER, Rig, TASKS, tools, walk};

/// The number of executions with each kind of fault, in the quick and in the long test.
const N_PER_KIND: usize = 8;
const N_PER_KIND_WITH_TIME: usize = 200;
/// The longest time from a detectable fault until the arms are at rest, seconds.
const STOPPED_S: f64 = 0.100;
/// The number of periods for which the arms are observed afterwards.
const N_AFTER: u32 = 40;
/// The drift of servos, radians per second.
const DRIFT_RADPS: f64 = 12.0 * std::f64::consts::PI / 180.0;
/// The smallest speed of a moving joint, radians per second.
const MOVING_RADPS: f64 = 6.0 * std::f64::consts::PI / 180.0;
/// The executor's limit of the distance from the motion, and its lag in periods.
const TRACKING_RAD: f64 = 2.0 * std::f64::consts::PI / 180.0;
const LAG_PERIODS: usize = 3;
const OWNER_STOP_S: f64 = 1.0;

/// The time, place and kind of a fault.
struct Plan {
    kind: Kind,
    seed: u64,
    motion: Motion,
    speed: f64,
    at_period: usize,
    arm: ArmIndex,
    joint: usize,
}

impl Plan {
    fn new(kind: Kind, seed: u64) -> Self {
        let mut rng = episode_rng(seed, 0, Stream::Reset);
        let area = match kind {
            Kind::DriftTogether => MIDDLE,
            Kind::DriftDown => LOW,
            _ => TASKS,
        };
        let motion = walk(area, 5000 + seed, 4);
        let speed = f64::from(uniform(&mut rng, 0.6, 1.0));
        let played = |periods: &usize| *periods as f64 * PERIOD_S * speed < motion.duration_s();
        let last = (0..).take_while(played).count() - 45;
        let mut plan = Self { kind, seed, motion, speed, at_period: 0, arm: ArmIndex(0), joint: 0 };
        for _ in 0..1000 {
            plan.at_period = 3 + index(&mut rng, last - 3);
            plan.arm = ArmIndex(index(&mut rng, 2));
            plan.joint = index(&mut rng, 4);
            if !matches!(kind, Kind::BlockedJoint | Kind::StateFrozen) || plan.moves() {
                return plan;
            }
        }
        panic!("no joint moves in walk {seed}");
    }

    /// True if the joint then moves in one direction for some time.
    fn moves(&self) -> bool {
        let rate = |later: usize| {
            let time_s = (self.at_period + later) as f64 * PERIOD_S * self.speed;
            self.motion.at(time_s)[self.arm.0].velocities[self.joint] * self.speed
        };
        let fast = |later: usize| rate(later) * rate(0).signum() > MOVING_RADPS;
        (0..=20).step_by(4).all(fast)
    }

    fn slack(&self) -> Slack {
        match self.kind {
            Kind::DriftTogether | Kind::DriftDown => {
                Slack { drift_radps: DRIFT_RADPS, gap_m: 0.003, sudden: true }
            }
            Kind::BlockedJoint => Slack { sudden: true, ..Slack::NONE },
            _ => Slack::NONE,
        }
    }

    /// Directions in which servos drift, arm by arm: those that move the tools together, or one down.
    fn drift(&self, rig: &Rig) -> Vec<Joints> {
        let (cell, angles) = (mico_cell(), rig.angles());
        let tools_m = tools(&cell, &angles);
        let between = (tools_m[1] - tools_m[0]).normalize();
        let along = |arm: usize| match (self.kind, arm) {
            (Kind::DriftTogether, 0) => between,
            (Kind::DriftTogether, _) => -between,
            (_, arm) if arm == self.arm.0 => DVec3::NEG_Z,
            _ => DVec3::ZERO,
        };
        let drift = |arm: usize| {
            let placed = &cell.arms[arm];
            let posture = ForwardKinematics::new(placed.model, &angles[arm]);
            let in_base = placed.world_from_base().inverse_transform_vector(&along(arm).into());
            let jacobian = posture.position_jacobian();
            let gain = Joints::from_fn(4, |joint| jacobian.column(joint).dot(&in_base));
            let most = gain.iter().fold(1e-9, |most: f64, gain| most.max(gain.abs()));
            Joints::from_fn(4, |joint| DRIFT_RADPS * gain[joint] / most)
        };
        vec![drift(0), drift(1)]
    }

    fn expected(&self, cause: &StopCause) -> bool {
        let too_near = matches!(cause, StopCause::ArmsGap(_) | StopCause::TableGap(_));
        match self.kind {
            Kind::StateLost => matches!(cause, StopCause::StateStale(_)),
            Kind::StateFrozen => matches!(cause, StopCause::Frozen(_) | StopCause::Tracking(_)),
            Kind::StateLate => matches!(cause, StopCause::StateDelayed(_)),
            Kind::StateNotFinite => matches!(cause, StopCause::StateNotFinite),
            Kind::SequenceJump => matches!(cause, StopCause::SequenceJump { .. }),
            Kind::EncoderJump => matches!(cause, StopCause::AngleJump(_)),
            Kind::CommandLost => matches!(cause, StopCause::CommandLost(_) | StopCause::DriveFault),
            Kind::DriverError => matches!(cause, StopCause::Driver(_)),
            Kind::OwnerGone => matches!(cause, StopCause::OwnerSilent(_)),
            Kind::PersonsStop => matches!(cause, StopCause::Requested),
            // A joint that is held looks like an encoder that is stuck.
            Kind::BlockedJoint => matches!(cause, StopCause::Frozen(_) | StopCause::Tracking(_)),
            Kind::TorqueOfContact => matches!(cause, StopCause::Torque(_)),
            Kind::ReportedContact => matches!(cause, StopCause::ContactReported),
            // A drift that cancels a joint's command looks like a stuck encoder.
            Kind::DriftTogether | Kind::DriftDown => {
                too_near || matches!(cause, StopCause::Tracking(_) | StopCause::Frozen(_))
            }
            Kind::ExecutorDropped | Kind::ProcessKilled => false,
        }
    }
}

/// The outcome of an execution.
struct Ending {
    cause: Option<StopCause>,
    /// The time from the detectable or detected fault until the arms were at rest, seconds.
    stopped_s: f64,
}

/// Plays the plan's motion until the arms have been at rest for a while after the fault.
fn execute(plan: &Plan) -> Ending {
    let what = format!("{:?} {}", plan.kind, plan.seed);
    let reports_torques = plan.kind != Kind::BlockedJoint;
    let config = SimulatedConfig { seed: plan.seed, reports_torques, ..SimulatedConfig::default() };
    let mut rig = Rig::ready(&plan.motion, config);
    let mut observer = Observer::new(plan.slack());
    rig.executor.start(OWNER, plan.motion.clone(), plan.speed, rig.now_s).unwrap();
    for _ in 0..plan.at_period {
        assert_ne!(rig.tick_owned(), Phase::Stopped, "{what}: {:?}", rig.executor.stopped_by());
        observer.look(&rig.pair.borrow(), &what);
    }
    let began_s = rig.pair.borrow().time_s();
    rig.injection.borrow_mut().begin(plan.kind, plan.arm, plan.joint);
    let disturbed = disturbance(plan.kind, plan.arm, plan.joint, &plan.drift(&rig));
    rig.pair.borrow_mut().disturb(disturbed);
    if matches!(plan.kind, Kind::ExecutorDropped | Kind::ProcessKilled) {
        return abandon(rig, plan, observer, began_s);
    }
    let mut shown_s = match plan.kind {
        Kind::OwnerGone => Some(began_s + OWNER_STOP_S),
        Kind::CommandLost | Kind::DriverError | Kind::PersonsStop => Some(began_s),
        _ => None,
    };
    if plan.kind == Kind::PersonsStop {
        rig.executor.stop(rig.now_s);
    }
    let mut past: Vec<Vec<Joints>> = Vec::new();
    let mut halted_s = None;
    for _ in 0..400 {
        let phase = if plan.kind == Kind::OwnerGone { rig.tick() } else { rig.tick_owned() };
        observer.look(&rig.pair.borrow(), &what);
        let time_s = rig.pair.borrow().time_s();
        past.extend(rig.executor.reference().map(<[Joints]>::to_vec));
        let off_rad = past.len().checked_sub(LAG_PERIODS + 1).map_or(0.0, |then| {
            let pairs = past[then].iter().zip(rig.angles());
            pairs.map(|(wanted, is)| wanted.largest_difference(&is)).fold(0.0, f64::max)
        });
        if off_rad > TRACKING_RAD {
            shown_s.get_or_insert(time_s);
        }
        if phase == Phase::Stopped {
            halted_s = Some(time_s);
            break;
        }
    }
    let halted_s = halted_s.unwrap_or_else(|| panic!("{what}: not stopped"));
    let stop = rig.executor.stopped_by().unwrap().clone();
    assert!(plan.expected(&stop.cause), "{what}: {stop}");
    stays_stopped(&mut rig, plan, &mut observer);
    let shown_s = shown_s.or(rig.injection.borrow().shown_s).unwrap_or(halted_s);
    // They moved at the end of one period and rested at the end of the next.
    Ending { cause: Some(stop.cause), stopped_s: observer.moved_s + PERIOD_S - shown_s }
}

/// Asserts that the arms come to rest and no request moves them.
fn stays_stopped(rig: &mut Rig, plan: &Plan, observer: &mut Observer) {
    let what = format!("{:?} {} afterwards", plan.kind, plan.seed);
    for _ in 0..12 {
        rig.tick_owned();
        observer.look(&rig.pair.borrow(), &what);
    }
    let rested = rig.angles();
    rig.injection.borrow_mut().end();
    rig.pair.borrow_mut().disturb(Default::default());
    for _ in 0..N_AFTER {
        assert_eq!(rig.tick_owned(), Phase::Stopped, "{what}");
        observer.look(&rig.pair.borrow(), &what);
        let started = rig.executor.start(OWNER, plan.motion.clone(), 1.0, rig.now_s);
        assert_eq!(started, Err(StartError::NotIdle(Phase::Stopped)), "{what}");
        assert_eq!(rig.angles(), rested, "{what}");
    }
}

/// Simulates the arms without an executor.
fn abandon(rig: Rig, plan: &Plan, mut observer: Observer, began_s: f64) -> Ending {
    let pair = rig.pair;
    match plan.kind {
        Kind::ExecutorDropped => drop(rig.executor),
        _ => std::mem::forget(rig.executor),
    }
    for _ in 0..N_AFTER {
        pair.borrow_mut().skip_period();
        observer.look(&pair.borrow(), &format!("{:?} {}", plan.kind, plan.seed));
    }
    Ending { cause: None, stopped_s: observer.moved_s + PERIOD_S - began_s }
}

#[test]
fn every_fault_at_any_time_stops_the_arms_within_their_limits() {
    execute_each_kind(N_PER_KIND);
}

#[test]
#[ignore = "takes a minute"]
fn two_hundred_of_every_fault_stop_the_arms_within_their_limits() {
    execute_each_kind(N_PER_KIND_WITH_TIME);
}

#[expect(clippy::print_stdout, reason = "measurements for --nocapture")]
fn execute_each_kind(n_per_kind: usize) {
    let (mut n, mut slowest, mut causes) = (0, BTreeMap::new(), BTreeMap::new());
    for idx in 0..n_per_kind * KINDS.len() {
        let (kind, seed) = (KINDS[idx % KINDS.len()], idx as u64);
        let ending = execute(&Plan::new(kind, seed));
        assert!(
            ending.stopped_s <= STOPPED_S + 1e-9,
            "{kind:?} {seed}: stopped after {} s by {:?}",
            ending.stopped_s,
            ending.cause
        );
        let slowest = slowest.entry(format!("{kind:?}")).or_insert(f64::NEG_INFINITY);
        *slowest = f64::max(*slowest, ending.stopped_s);
        let cause = ending.cause.map_or("drives".into(), |cause| format!("{cause:?}"));
        let cause = cause.split(['(', ' ']).next().unwrap_or_default().to_owned();
        *causes.entry(cause).or_insert(0) += 1;
        n += 1;
    }
    println!("{n} executions, seconds to rest at most {slowest:.3?}");
    println!("stopped by {causes:?}");
    assert!(n >= 100);
    // The drifts lead to every limit that keeps the arms apart from each other and from the table.
    assert!(causes.contains_key("ArmsGap") && causes.contains_key("TableGap"), "{causes:?}");
}
