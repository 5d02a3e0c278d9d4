//! The simulated pair behind an executor, with a simulated clock, measurements and an observer.

use glam::DVec3;
use tandem_core::scene::Scene;
use tandem_core::{ArmIndex, Contacts};
use tandem_kinematics::{ForwardKinematics, Joints, Motion, PlacedArm, WorkCell};

use crate::simulated::{ObjectPose, PERIOD_S, SimulatedPair};
use crate::trial::outcome::{FailureCause, MotionRefusal};
use crate::trial::{Frame, PathPoint, TrialError, TrialObserver};
use tandem_bridge::driver::ArmReading;
use tandem_bridge::executor::{Executor, Phase, ResetError, Settings, Stop, Token};

/// The only owner.
const OWNER: Token = Token(1);
/// Periods until there are enough good states for a reset.
const N_WARM_UP: usize = 15;
/// The torque from which a closed loop yields, and its least increase over that at the motion's start; newton metres.
/// The envelope stops the arms at 4.
const YIELD_NM: f64 = 1.5;
const YIELD_INCREASE_NM: f64 = 0.5;
/// The longest time from a stop to a reset, periods.
const N_RESET: usize = 100;
/// Periods between two frames.
const FRAME_PERIODS: u64 = 4;

/// The goals of a trial. They only appear in the frames.
#[derive(Default)]
pub(crate) struct Goals {
    /// The goals of the objects, arm by arm; world frame, metres.
    pub(crate) at_m: Vec<DVec3>,
    /// The distance up to which a goal counts as achieved, metres.
    pub(crate) tolerance_m: f32,
}

/// The arms of a trial and its measurements.
pub(crate) struct TrialRig<'a> {
    executor: Executor<SimulatedPair>,
    cell: WorkCell,
    observer: &'a mut dyn TrialObserver,
    goals: Goals,
    n_periods: u64,
    pub(crate) touched: Contacts,
    pub(crate) arms_gap_m: f64,
    pub(crate) table_gap_m: f64,
    /// The largest height of each object, world frame, metres.
    pub(crate) highest_m: Vec<f64>,
    pub(crate) path: Vec<PathPoint>,
}

impl<'a> TrialRig<'a> {
    /// Resets the arms of `pair`.
    pub(crate) fn new(
        cell: WorkCell,
        pair: SimulatedPair,
        goals: Goals,
        observer: &'a mut dyn TrialObserver,
    ) -> Result<Self, TrialError> {
        let highest_m = vec![f64::NEG_INFINITY; pair.objects().len()];
        let executor = Executor::new(cell.clone(), pair, Settings::default());
        let executor = executor.expect("the default settings are valid");
        let mut rig = Self {
            executor,
            cell,
            observer,
            goals,
            n_periods: 0,
            touched: Contacts::NONE,
            arms_gap_m: f64::INFINITY,
            table_gap_m: f64::INFINITY,
            highest_m,
            path: Vec::new(),
        };
        for _ in 0..N_WARM_UP {
            rig.tick();
        }
        rig.executor.reset(OWNER, rig.now_s())?;
        Ok(rig)
    }

    /// The time since the start, seconds.
    pub(crate) fn now_s(&self) -> f64 {
        self.n_periods as f64 * PERIOD_S
    }

    /// Plays `motion` to its end.
    pub(crate) fn play(&mut self, motion: Motion, speed: f64) -> Result<(), FailureCause> {
        self.start(motion, speed)?;
        while self.tick() != Phase::Idle {
            self.check()?;
        }
        Ok(())
    }

    fn start(&mut self, motion: Motion, speed: f64) -> Result<(), FailureCause> {
        let now_s = self.now_s();
        let started = self.executor.start(OWNER, motion, speed, now_s);
        started.map_err(|error| FailureCause::Refused(MotionRefusal::from(error)))
    }

    /// Plays `motion` to its end, or until an external torque shows that an arm that `yields` presses on something. All
    /// arms then hold their positions, with their grippers as open as they are. Returns whether the motion came to its
    /// end.
    pub(crate) fn play_yielding(
        &mut self,
        motion: Motion,
        speed: f64,
        yields: &[bool],
    ) -> Result<bool, FailureCause> {
        let torques = |rig: &Self| -> Vec<f64> {
            let arms = rig.executor.state().map(|state| state.arms.as_slice()).unwrap_or_default();
            let yielding = arms.iter().zip(yields).filter(|(_, yields)| **yields);
            let joints = yielding
                .flat_map(|(arm, _)| arm.torques_nm.iter().flat_map(|torques| torques.iter()));
            joints.map(|torque| torque.abs()).collect()
        };
        let before = torques(self);
        self.start(motion, speed)?;
        while self.tick() != Phase::Idle {
            self.check()?;
            let presses = torques(self)
                .iter()
                .zip(&before)
                .any(|(torque, before)| *torque > YIELD_NM.max(before + YIELD_INCREASE_NM));
            if presses {
                self.executor.stop(self.now_s());
                return self.reset().map(|()| false);
            }
        }
        Ok(true)
    }

    /// Makes the stopped arms idle once they are at rest.
    fn reset(&mut self) -> Result<(), FailureCause> {
        let mut reported = None;
        for _ in 0..N_RESET {
            self.tick();
            match self.executor.reset(OWNER, self.now_s()) {
                Ok(()) => return Ok(()),
                Err(ResetError::Reported { arm, cause }) => reported = Some((Some(arm), cause)),
                Err(ResetError::Limit { arm, cause }) => reported = Some((arm, cause)),
                Err(_) => {}
            }
        }
        let Some((arm, cause)) = reported else { return self.check() };
        let when_s = self.now_s();
        Err(FailureCause::Stopped(Stop { when_s, arm, joint: None, cause }))
    }

    /// Returns the forces on the tools by the measured torques, world frame, newtons.
    pub(crate) fn forces_n(&self) -> Vec<DVec3> {
        let arms = self.executor.state().map(|state| state.arms.as_slice()).unwrap_or_default();
        let of_arm = |(placed, arm): (&PlacedArm, &ArmReading)| {
            let posture = ForwardKinematics::new(placed.model, &arm.angles);
            arm.torques_nm
                .and_then(|torques| posture.tool_force(&torques))
                .map_or(DVec3::ZERO, |force_n| (placed.world_from_base() * force_n).into())
        };
        self.cell.arms.iter().zip(arms).map(of_arm).collect()
    }

    /// Waits for `time_s` without a motion.
    pub(crate) fn wait(&mut self, time_s: f64) -> Result<(), FailureCause> {
        let until_s = self.now_s() + time_s;
        while self.now_s() < until_s {
            self.tick();
            self.check()?;
        }
        Ok(())
    }

    /// Returns the objects in the next camera picture.
    pub(crate) fn observe_objects(&mut self) -> Result<Vec<ObjectPose>, FailureCause> {
        let from_s = self.pair().time_s();
        loop {
            self.tick();
            self.check()?;
            let seen = self.pair().observed_objects();
            if seen.iter().all(|object| object.time_s >= from_s) {
                return Ok(seen.to_vec());
            }
        }
    }

    pub(crate) fn pair(&self) -> &SimulatedPair {
        self.executor.driver()
    }

    /// The measured angles (radians) and gripper openings, arm by arm.
    pub(crate) fn encoders(&self) -> Vec<(Joints, f64)> {
        let arms = self.executor.state().map(|state| state.arms.as_slice()).unwrap_or_default();
        arms.iter().map(|arm| (arm.angles, arm.opening)).collect()
    }

    fn check(&self) -> Result<(), FailureCause> {
        match self.executor.stopped_by() {
            Some(stop) => Err(FailureCause::Stopped(stop.clone())),
            None => Ok(()),
        }
    }

    fn tick(&mut self) -> Phase {
        self.n_periods += 1;
        let now_s = self.now_s();
        let owned = self.executor.acquire(OWNER, now_s);
        debug_assert!(owned.is_ok(), "there is only one owner");
        let phase = self.executor.tick(now_s);
        self.record(phase);
        phase
    }

    fn record(&mut self, phase: Phase) {
        let pair = self.executor.driver();
        self.touched = self.touched | pair.contacts();
        let gaps = pair.gaps();
        self.arms_gap_m = self.arms_gap_m.min(gaps.arms_m);
        self.table_gap_m = gaps.table_m.iter().copied().fold(self.table_gap_m, f64::min);
        for (highest_m, object) in self.highest_m.iter_mut().zip(pair.objects()) {
            *highest_m = highest_m.max(object.at_m.z);
        }
        if !self.n_periods.is_multiple_of(FRAME_PERIODS) {
            return;
        }
        let time_s = self.n_periods as f64 * PERIOD_S;
        let planned = self.executor.reference();
        let tools_at = |angles: &[Joints]| tool_positions(&self.cell, angles);
        let n_arms = self.cell.arms.len();
        let angles: Vec<Joints> = (0..n_arms).map(|arm| *pair.angles(ArmIndex(arm))).collect();
        let tools = PathPoint {
            time_s,
            planned: planned.map(tools_at).unwrap_or_default(),
            measured: tools_at(&angles),
        };
        let goals = self.goals.at_m.iter().map(|goal| goal.as_vec3().to_array()).collect();
        let goal_tolerance_m = self.goals.tolerance_m;
        let scene = Scene { goals, goal_tolerance_m, time_s, ..pair.scene() };
        let measured = self.executor.state();
        let frame = Frame { time_s, phase, scene, planned, measured, tools: &tools };
        self.observer.on_frame(&frame);
        self.path.push(tools);
    }
}

/// Returns the positions of the tools at joint angles `angles` (radians), world frame, metres.
pub(crate) fn tool_positions(cell: &WorkCell, angles: &[Joints]) -> Vec<DVec3> {
    let arms = cell.arms.iter().zip(angles);
    arms.map(|(placed, angles)| {
        (placed.world_from_base() * ForwardKinematics::new(placed.model, angles).tool_m()).into()
    })
    .collect()
}
