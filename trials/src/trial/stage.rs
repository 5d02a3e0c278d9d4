//! The simulated pair behind an executor, with a clock of its own and somebody who keeps account.

use glam::DVec3;
use tandem_core::scene::Scene;
use tandem_core::{ArmIndex, Contacts};
use tandem_kinematics::{Cell, Joints, Motion, Posture};

use crate::simulated::{ObjectPose, PERIOD_S, SimulatedPair};
use crate::trial::judge::{Cause, RefusedBy};
use crate::trial::{Look, PathPoint, TrialError, Witness};
use tandem_bridge::executor::{Executor, Phase, Settings, Token};

/// The one owner.
const OWNER: Token = Token(1);
/// Periods until enough good states have come for a reset.
const N_WARM_UP: usize = 15;
/// Periods from one look to the next.
const LOOK_EVERY: u64 = 4;

/// What moves, and what is noted about it.
pub(crate) struct Stage<'a> {
    executor: Executor<SimulatedPair>,
    cell: Cell,
    witness: &'a mut dyn Witness,
    goals: Vec<DVec3>,
    n_periods: u64,
    pub(crate) touched: Contacts,
    pub(crate) arms_gap_m: f64,
    pub(crate) table_gap_m: f64,
    /// The highest each object was, world frame, metres.
    pub(crate) highest_m: Vec<f64>,
    pub(crate) path: Vec<PathPoint>,
}

impl<'a> Stage<'a> {
    /// Lets the arms of `pair` go; `goals` (world, metres) are for pictures only.
    pub(crate) fn new(
        cell: Cell,
        pair: SimulatedPair,
        goals: Vec<DVec3>,
        witness: &'a mut dyn Witness,
    ) -> Result<Self, TrialError> {
        let highest_m = vec![f64::NEG_INFINITY; pair.objects().len()];
        let executor = Executor::new(cell.clone(), pair, Settings::default());
        let executor = executor.expect("the default settings make sense");
        let mut stage = Self {
            executor,
            cell,
            witness,
            goals,
            n_periods: 0,
            touched: Contacts::NONE,
            arms_gap_m: f64::INFINITY,
            table_gap_m: f64::INFINITY,
            highest_m,
            path: Vec::new(),
        };
        for _ in 0..N_WARM_UP {
            stage.tick();
        }
        stage.executor.reset(OWNER, stage.now_s())?;
        Ok(stage)
    }

    /// Time since the start, seconds.
    pub(crate) fn now_s(&self) -> f64 {
        self.n_periods as f64 * PERIOD_S
    }

    /// Plays `motion` to its end.
    pub(crate) fn play(&mut self, motion: Motion, speed: f64) -> Result<(), Cause> {
        let now_s = self.now_s();
        let started = self.executor.start(OWNER, motion, speed, now_s);
        started.map_err(|error| Cause::Refused(RefusedBy::from(error)))?;
        while self.tick() != Phase::Idle {
            self.check()?;
        }
        Ok(())
    }

    /// Lets `time_s` pass in which nothing is commanded.
    pub(crate) fn wait(&mut self, time_s: f64) -> Result<(), Cause> {
        let until_s = self.now_s() + time_s;
        while self.now_s() < until_s {
            self.tick();
            self.check()?;
        }
        Ok(())
    }

    /// The objects in a picture that was taken from now on.
    pub(crate) fn look(&mut self) -> Result<Vec<ObjectPose>, Cause> {
        let from_s = self.pair().time_s();
        loop {
            self.tick();
            self.check()?;
            let seen = self.pair().seen();
            if seen.iter().all(|object| object.time_s >= from_s) {
                return Ok(seen.to_vec());
            }
        }
    }

    pub(crate) fn pair(&self) -> &SimulatedPair {
        self.executor.driver()
    }

    /// What the encoders say: angles (radians) and openings, arm by arm.
    pub(crate) fn encoders(&self) -> Vec<(Joints, f64)> {
        let arms = self.executor.state().map(|state| state.arms.as_slice()).unwrap_or_default();
        arms.iter().map(|arm| (arm.angles, arm.opening)).collect()
    }

    fn check(&self) -> Result<(), Cause> {
        match self.executor.stopped_by() {
            Some(stop) => Err(Cause::Stopped(stop.clone())),
            None => Ok(()),
        }
    }

    fn tick(&mut self) -> Phase {
        self.n_periods += 1;
        let now_s = self.now_s();
        let owned = self.executor.acquire(OWNER, now_s);
        debug_assert!(owned.is_ok(), "there is one owner only");
        let phase = self.executor.tick(now_s);
        self.note(phase);
        phase
    }

    fn note(&mut self, phase: Phase) {
        let pair = self.executor.driver();
        self.touched = self.touched | pair.contacts();
        let gaps = pair.gaps();
        self.arms_gap_m = self.arms_gap_m.min(gaps.arms_m);
        self.table_gap_m = gaps.table_m.iter().copied().fold(self.table_gap_m, f64::min);
        for (highest_m, object) in self.highest_m.iter_mut().zip(pair.objects()) {
            *highest_m = highest_m.max(object.at_m.z);
        }
        if !self.n_periods.is_multiple_of(LOOK_EVERY) {
            return;
        }
        let time_s = self.n_periods as f64 * PERIOD_S;
        let planned = self.executor.reference();
        let at = |angles: &[Joints]| tools(&self.cell, angles);
        let n_arms = self.cell.arms.len();
        let angles: Vec<Joints> = (0..n_arms).map(|arm| *pair.angles(ArmIndex(arm))).collect();
        let tools = PathPoint {
            time_s,
            planned: planned.map(at).unwrap_or_default(),
            measured: at(&angles),
        };
        let goals = self.goals.iter().map(|goal| goal.as_vec3().to_array()).collect();
        let scene = Scene { goals, time_s, ..pair.scene() };
        let measured = self.executor.state();
        let look = Look { time_s, phase, scene, planned, measured, tools: &tools };
        self.witness.look(&look);
        self.path.push(tools);
    }
}

/// Where the tools are, world frame, metres.
pub(crate) fn tools(cell: &Cell, angles: &[Joints]) -> Vec<DVec3> {
    let arms = cell.arms.iter().zip(angles);
    arms.map(|(placed, angles)| {
        placed.world_from_base(Posture::of(placed.model, angles).tool().origin_m)
    })
    .collect()
}
