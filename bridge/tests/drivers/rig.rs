//! An executor on a driver of real arms. Time advances with exchanges and not by a clock.

use std::cell::Cell;
use std::rc::Rc;
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::Duration;

use glam::DVec3;
use tandem_bridge::work_cell::{check_settings, mico_cell};
use tandem_bridge::{
    Command, Driver, DriverError, Executor, PairState, Phase, ResetError, Settings, StopCause,
    Token,
};
use tandem_core::ArmIndex;
use tandem_kinematics::{ArmWaypoint, Joints, Motion, PlanSettings, Waypoint, check, plan};
use tandem_trials::{SimulatedConfig, SimulatedPair};

pub(crate) const OWNER: Token = Token(5);
pub(crate) const PERIOD_S: f64 = 0.01;

/// The sequence number of the state that a driver receives by connecting.
const FIRST: u64 = 1;

/// A pair that a stand-in moves and a test inspects.
pub(crate) type SharedPair = Arc<Mutex<SimulatedPair>>;

/// A driver that can wait for a state.
pub(crate) trait Listen: Driver {
    fn listen(&mut self, patience: Duration) -> Result<PairState, DriverError>;
}

/// Exchanges, simulates a period on the other side, and waits for its state on machines of any speed.
pub(crate) struct Patient<D> {
    pub(crate) inner: D,
    /// Simulates a period on the other side, unless time advances there by itself.
    pass: Box<dyn FnMut()>,
    /// True to wait for states; false in tests without states.
    waits: Rc<Cell<bool>>,
    seen: u64,
}

impl<D> Patient<D> {
    pub(crate) fn new(inner: D, waits: &Rc<Cell<bool>>, pass: impl FnMut() + 'static) -> Self {
        Self { inner, pass: Box::new(pass), waits: Rc::clone(waits), seen: FIRST }
    }
}

impl<D: Listen> Driver for Patient<D> {
    fn period_s(&self) -> f64 {
        self.inner.period_s()
    }

    fn exchange(&mut self, command: &Command) -> Result<PairState, DriverError> {
        let state = self.inner.exchange(command);
        (self.pass)();
        let mut state = state?;
        for _ in 0..600 {
            if !self.waits.get() || self.seen != state.sequence {
                break;
            }
            state = self.inner.listen(Duration::from_millis(100))?;
        }
        self.seen = state.sequence;
        Ok(state)
    }

    fn stop(&mut self) -> Result<(), DriverError> {
        self.inner.stop()
    }

    fn disconnect(&mut self, reason: &DriverError) {
        self.inner.disconnect(reason);
    }

    fn confirms_stop(&self) -> bool {
        self.inner.confirms_stop()
    }
}

/// The executor and its clock.
pub(crate) struct Rig<D: Driver> {
    pub(crate) executor: Executor<D>,
    pub(crate) now_s: f64,
}

impl<D: Driver> Rig<D> {
    pub(crate) fn new(driver: D, settings: Settings) -> Self {
        Self { executor: Executor::new(mico_cell(), driver, settings).unwrap(), now_s: 77.0 }
    }

    /// Simulates a period with a sign of life of the owner.
    pub(crate) fn tick(&mut self) -> Phase {
        self.now_s += PERIOD_S;
        self.executor.acquire(OWNER, self.now_s).unwrap();
        self.executor.tick(self.now_s)
    }

    /// Resets stopped arms.
    pub(crate) fn reset(&mut self) {
        let phase = self.try_reset();
        assert_eq!(phase, Phase::Idle, "{:?}", self.executor.stopped_by());
    }

    /// Resets, and ticks once.
    pub(crate) fn try_reset(&mut self) -> Phase {
        for _ in 0..15 {
            assert_eq!(self.tick(), Phase::Stopped);
        }
        // Some arms report less often than others.
        for _ in 0..100 {
            let reset = self.executor.reset(OWNER, self.now_s);
            if let Err(ResetError::States { .. } | ResetError::Unconfirmed) = reset {
                self.tick();
            }
        }
        self.tick()
    }

    /// Starts `motion`.
    pub(crate) fn start(&mut self, motion: &Motion) {
        self.executor.start(OWNER, motion.clone(), 1.0, self.now_s).unwrap();
    }

    /// Plays the motion to its end. Returns the number of ticks.
    pub(crate) fn play(&mut self) -> usize {
        for n in 1..100_000 {
            match self.tick() {
                Phase::Idle => return n,
                Phase::Stopped => panic!("{}", self.executor.stopped_by().unwrap()),
                _ => {}
            }
        }
        panic!("no end");
    }

    /// Ticks until the executor stops. Returns the cause.
    pub(crate) fn until_stopped(&mut self) -> StopCause {
        for _ in 0..2000 {
            if self.tick() == Phase::Stopped {
                return self.executor.stopped_by().unwrap().cause.clone();
            }
        }
        panic!("not stopped");
    }
}

/// The error of the driver.
pub(crate) fn failure(cause: &StopCause) -> &DriverError {
    match cause {
        StopCause::Driver(error) => error,
        other => panic!("stopped by {other}"),
    }
}

/// Arms at rest at the start of `motion`.
pub(crate) fn pair_at(motion: &Motion) -> SharedPair {
    let at: Vec<Joints> = motion.arms.iter().map(|samples| samples[0].angles).collect();
    let opening = motion.arms[0][0].gripper_opening;
    Arc::new(Mutex::new(SimulatedPair::new(mico_cell(), &at, opening, SimulatedConfig::default())))
}

/// The true joint angles.
pub(crate) fn angles(pair: &SharedPair) -> Vec<Joints> {
    let pair = pair.lock().unwrap();
    [0, 1].map(|arm| *pair.angles(ArmIndex(arm))).to_vec()
}

/// Returns true if nothing moves. Arms that follow a velocity of zero come to rest gradually.
pub(crate) fn at_rest(pair: &SharedPair) -> bool {
    let pair = pair.lock().unwrap();
    let rest = |arm| pair.velocities(ArmIndex(arm)).iter().all(|rate| rate.abs() < 1e-4);
    rest(0) && rest(1)
}

/// Asserts that the arms are at the end of `motion`.
pub(crate) fn assert_ended(pair: &SharedPair, motion: &Motion) {
    for (samples, angles) in motion.arms.iter().zip(angles(pair)) {
        let off_rad = samples[samples.len() - 1].angles.largest_difference(&angles);
        assert!(off_rad < 0.3_f64.to_radians(), "{off_rad} rad from the end");
    }
}

/// Waits until a condition holds, on machines of any speed.
pub(crate) fn eventually(what: &str, mut so: impl FnMut() -> bool) {
    for _ in 0..12_000 {
        if so() {
            return;
        }
        thread::sleep(Duration::from_millis(10));
    }
    panic!("{what}: not in two minutes");
}

/// Both arms out and back above the table, with gripper openings by `openings`.
pub(crate) fn sweep(openings: [f64; 4]) -> Motion {
    let cell = mico_cell();
    let places = [
        [DVec3::new(-0.04, -0.05, 0.10), DVec3::new(-0.02, 0.04, 0.12)],
        [DVec3::new(0.00, 0.00, 0.06), DVec3::new(-0.05, 0.00, 0.08)],
        [DVec3::new(-0.03, 0.04, 0.08), DVec3::new(-0.04, -0.05, 0.06)],
        [DVec3::new(-0.05, 0.02, 0.10), DVec3::new(-0.02, -0.02, 0.10)],
    ];
    let waypoint = |(own, opening): (&[DVec3; 2], f64)| {
        let tool = |arm: usize| cell.world_from_arm(ArmIndex(arm), &own[arm].into());
        [0, 1]
            .map(|arm| ArmWaypoint { tool_in_world_m: tool(arm), gripper_opening: opening })
            .to_vec()
    };
    let waypoints: Vec<Waypoint> = places.iter().zip(openings).map(waypoint).collect();
    let start = cell.ready(0.05).unwrap();
    let motion = plan(&cell, &waypoints, &start, &PlanSettings::default()).unwrap().sampled(100.0);
    let at: Vec<Joints> = motion.arms.iter().map(|samples| samples[0].angles).collect();
    check(&cell, &motion, &at, &check_settings()).unwrap();
    motion
}
