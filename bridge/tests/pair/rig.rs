//! A simulated pair behind an executor.

use std::cell::RefCell;
use std::rc::Rc;

use glam::DVec3;
use tandem_bridge::work_cell::{check_settings, mico_cell};
use tandem_bridge::{Executor, Phase, Settings, Token};
use tandem_core::rng::uniform;
use tandem_core::{Stream, episode_rng};
use tandem_kinematics::model::Joint;
use tandem_kinematics::{
    ArmWaypoint, ForwardKinematics, Joints, Motion, PlanSettings, Waypoint, WorkCell, check, plan,
};
use tandem_trials::simulated::PERIOD_S;
use tandem_trials::{SimulatedConfig, SimulatedPair};

use crate::pair::injection::{Injection, Tap};

pub(crate) const OWNER: Token = Token(77);

/// The executor, the pair behind it, and the clock of both.
pub(crate) struct Rig {
    pub(crate) executor: Executor<Tap>,
    pub(crate) pair: Rc<RefCell<SimulatedPair>>,
    pub(crate) injection: Rc<RefCell<Injection>>,
    pub(crate) now_s: f64,
}

impl Rig {
    /// Arms at rest at the start of `motion`.
    pub(crate) fn new(motion: &Motion, config: SimulatedConfig) -> Self {
        let at: Vec<Joints> = motion.arms.iter().map(|samples| samples[0].angles).collect();
        let pair = SimulatedPair::new(mico_cell(), &at, motion.arms[0][0].gripper_opening, config);
        let pair = Rc::new(RefCell::new(pair));
        let injection = Rc::new(RefCell::new(Injection::none()));
        let tap = Tap::new(Rc::clone(&pair), Rc::clone(&injection));
        let executor = Executor::new(mico_cell(), tap, Settings::default()).unwrap();
        // The clocks of the arms and of the executor are independent.
        Self { executor, pair, injection, now_s: 1234.5 }
    }

    /// The same, owned and reset.
    pub(crate) fn ready(motion: &Motion, config: SimulatedConfig) -> Self {
        let mut rig = Self::new(motion, config);
        rig.executor.acquire(OWNER, rig.now_s).unwrap();
        for _ in 0..15 {
            assert_eq!(rig.tick(), Phase::Stopped);
        }
        rig.executor.reset(OWNER, rig.now_s).unwrap();
        assert_eq!(rig.tick(), Phase::Idle);
        rig
    }

    /// Simulates a period.
    pub(crate) fn tick(&mut self) -> Phase {
        self.now_s += PERIOD_S;
        self.executor.tick(self.now_s)
    }

    /// Simulates a period with a sign of life of the owner.
    pub(crate) fn tick_owned(&mut self) -> Phase {
        let owned = self.executor.acquire(OWNER, self.now_s);
        assert_eq!(owned, Ok(()));
        self.tick()
    }

    /// The true joint angles.
    pub(crate) fn angles(&self) -> Vec<Joints> {
        let pair = self.pair.borrow();
        [0, 1].map(|arm| *pair.angles(tandem_core::ArmIndex(arm))).to_vec()
    }

    /// Plays `motion` to its end and calls `look` after every period.
    pub(crate) fn play(&mut self, motion: Motion, speed: f64, mut look: impl FnMut(&Self)) {
        self.executor.start(OWNER, motion, speed, self.now_s).unwrap();
        loop {
            let phase = self.tick_owned();
            look(self);
            match phase {
                Phase::Idle => return,
                Phase::Stopped => panic!("{}", self.executor.stopped_by().unwrap()),
                _ => {}
            }
        }
    }
}

/// The positions of the tools, world frame, metres.
pub(crate) fn tools(cell: &WorkCell, angles: &[Joints]) -> Vec<DVec3> {
    let tool = |(arm, angles): (usize, &Joints)| {
        let placed = &cell.arms[arm];
        (placed.world_from_base() * ForwardKinematics::new(placed.model, angles).tool_m()).into()
    };
    angles.iter().enumerate().map(tool).collect()
}

/// Plans and checks the motion through points of the arms' base frames, metres.
pub(crate) fn planned(points: &[([DVec3; 2], f64)]) -> Motion {
    let cell = mico_cell();
    let waypoints: Vec<Waypoint> = points
        .iter()
        .map(|(points, opening)| {
            let in_world =
                |arm: usize| cell.arms[arm].world_from_base().transform_point(&points[arm].into());
            let waypoint =
                |arm| ArmWaypoint { tool_in_world_m: in_world(arm), gripper_opening: *opening };
            vec![waypoint(0), waypoint(1)]
        })
        .collect();
    let start = cell.ready(0.05).unwrap();
    let motion = plan(&cell, &waypoints, &start, &PlanSettings::default()).unwrap().sampled(100.0);
    let at: Vec<Joints> = motion.arms.iter().map(|samples| samples[0].angles).collect();
    check(&cell, &motion, &at, &check_settings()).unwrap();
    motion
}

/// An area of random motions in the arm frames: low and high corner, metres.
pub(crate) type Area = [DVec3; 2];

/// The complete area of the tasks.
pub(crate) const TASKS: Area = [DVec3::new(-0.12, -0.12, 0.005), DVec3::new(0.12, 0.12, 0.20)];
/// The area close to the table.
pub(crate) const LOW: Area = [DVec3::new(-0.06, -0.12, 0.005), DVec3::new(0.04, 0.12, 0.012)];
/// The area between the arms.
pub(crate) const MIDDLE: Area = [DVec3::new(0.06, -0.08, 0.02), DVec3::new(0.09, 0.08, 0.10)];

/// A random motion of both arms that the check passes: `n` waypoints up to 5 cm apart.
pub(crate) fn walk([low, high]: Area, seed: u64, n: usize) -> Motion {
    let cell = mico_cell();
    for attempt in 0.. {
        let mut rng = episode_rng(seed, attempt, Stream::Exploration);
        let mut own = [low.midpoint(high); 2];
        let mut waypoints: Vec<Waypoint> = Vec::new();
        for idx in 0..n {
            let longest_m = if idx == 0 { 0.10 } else { 0.05 };
            for own in &mut own {
                let step = [0; 3].map(|_| f64::from(uniform(&mut rng, -1.0, 1.0)));
                let step = DVec3::from_array(step).clamp_length_max(1.0) * longest_m;
                *own = (*own + step).clamp(low, high);
            }
            let opening = f64::from(uniform(&mut rng, 0.0, 1.0));
            let tool =
                |arm: usize| cell.world_from_arm(tandem_core::ArmIndex(arm), &own[arm].into());
            let waypoint =
                |arm| ArmWaypoint { tool_in_world_m: tool(arm), gripper_opening: opening };
            waypoints.push(vec![waypoint(0), waypoint(1)]);
        }
        let start = cell.ready(0.05).unwrap();
        let Ok(trajectory) = plan(&cell, &waypoints, &start, &PlanSettings::default()) else {
            continue;
        };
        let motion = trajectory.sampled(100.0);
        let at: Vec<Joints> = motion.arms.iter().map(|samples| samples[0].angles).collect();
        // The executor keeps joints one degree away from the ends of their ranges.
        let inner = |(angle, joint): (&f64, &Joint)| {
            let [low, high] = joint.range_rad;
            (low + 0.018..high - 0.018).contains(angle)
        };
        let clear = motion.arms.iter().zip(&cell.arms).all(|(samples, placed)| {
            samples.iter().all(|s| s.angles.iter().zip(placed.model.joints).all(inner))
        });
        if clear && check(&cell, &motion, &at, &check_settings()).is_ok() {
            return motion;
        }
    }
    unreachable!("some walk is good")
}
