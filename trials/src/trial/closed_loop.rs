//! The steps of the closed loop: each observes, asks the policy and moves the arms. [`episodes`] repeats them.

use glam::{DVec3, EulerRot};
use rand_chacha::ChaCha8Rng;
use tandem_core::ArmIndex;
use tandem_core::scene::Cuboid;
use tandem_kinematics::{Joints, Waypoint};

use self::progress::Progress;
use crate::simulated::{ObjectPose, SharedObject};
use crate::trial::ActionSource;
use crate::trial::block_avoidance::ObservedBlock;
use crate::trial::mapping::ArmObservation;
use crate::trial::outcome::FailureCause;
use crate::trial::rehearsal::TrialStart;
use crate::trial::rig::TrialRig;
use crate::trial::runner::TrialRunner;

mod episodes;
mod grasping;
mod nudging;
mod order;
mod progress;
mod recalling;
mod sparing;
mod squeezing;
mod step_motion;
mod yielding;

/// Share of the tolerance of its goal within which an object counts as placed.
const DONE_SHARE: f64 = 0.9;

/// The closed loop of one trial. Its methods move the arms; those of the runner decide how.
pub(super) struct ClosedLoop<'a, 'rig> {
    runner: &'a TrialRunner,
    rig: &'a mut TrialRig<'rig>,
    start: &'a TrialStart,
    policy: &'a mut dyn ActionSource,
    state: LoopState,
    /// The number of steps, and of those that the arms did not carry out in full.
    n_steps: usize,
    n_shortened: usize,
    /// Whether the time limit has passed.
    timed_out: bool,
}

/// What the policy wants in a step, and what is in the way.
struct WantedStep<'a> {
    /// The end effectors after the step, arm frames, metres.
    hands: Vec<DVec3>,
    /// The openings after the step, metres on each side.
    openings_m: Vec<f64>,
    blocks: &'a [ObservedBlock],
}

/// The state of the closed loop.
struct LoopState {
    /// The commanded joint angles, radians.
    joint_angles: Vec<Joints>,
    /// The commanded openings, metres on each side.
    openings_m: Vec<f64>,
    /// The velocities of the training world's hands, arm frames, metres per second.
    velocities: Vec<DVec3>,
    before: Option<Vec<ArmObservation>>,
    /// The number of consecutive observations with every object at its goal.
    n_done: usize,
    /// The number of consecutive judgements, up to now, that found the task achieved.
    n_in_success: usize,
    /// Whether each arm holds an object that all arms share.
    holds: Vec<bool>,
    progress: Progress,
    /// Whether each gripper opens only as wide as its object needs, because another object lies next to it.
    narrow: Vec<bool>,
    /// By how much each hand is to withdraw from what it presses on, arm frames, metres.
    withdraw: Option<Vec<DVec3>>,
    /// The arms that stay out of the other arm's way: their objects are at their goals, or they wait for their turn.
    parked: Vec<bool>,
    /// The number of times that an arm has waited for its turn.
    n_waits: usize,
    /// The generator of the noise in the actions, once they have noise.
    noise: Option<ChaCha8Rng>,
    /// The waypoints of the tools so far.
    waypoints: Vec<Waypoint>,
}

impl<'a, 'rig> ClosedLoop<'a, 'rig> {
    /// Starts the closed loop of `runner` with the arms at `joint_angles` (radians), those of `start`.
    pub(super) fn new(
        runner: &'a TrialRunner,
        rig: &'a mut TrialRig<'rig>,
        start: &'a TrialStart,
        joint_angles: &[Joints],
        policy: &'a mut dyn ActionSource,
    ) -> Self {
        let state = LoopState::new(start, joint_angles);
        Self { runner, rig, start, policy, state, n_steps: 0, n_shortened: 0, timed_out: false }
    }

    /// Carries out one step. Returns whether the arms carried out the policy's whole action.
    fn step(&mut self) -> Result<bool, FailureCause> {
        let (runner, state) = (self.runner, &mut self.state);
        let layout = runner.config.layout;
        let objects = self.rig.observe_objects()?;
        if state.before.is_some() {
            state.count_success(runner.is_success(self.rig, self.start));
        }
        let now: Vec<ArmObservation> = self
            .rig
            .encoders()
            .iter()
            .zip(&objects)
            .enumerate()
            .map(|(arm, ((angles, opening), object))| {
                let velocity = state.velocities[arm];
                runner.mapping.observe(ArmIndex(arm), angles, *opening, velocity, object)
            })
            .collect();
        let seen = runner.held_as_in_training(&now, state);
        let before = state.before.replace(seen.clone()).unwrap_or_else(|| seen.clone());
        let mut observation = vec![0.0; layout.n_observation()];
        let mut goal = vec![0.0; layout.n_goal()];
        for arm in layout.arms() {
            let numbers = &mut observation[layout.observation_of(arm)];
            runner.mapping.write_observation(&seen[arm.0], &before[arm.0], numbers);
            goal[layout.goal_of(arm)]
                .copy_from_slice(&self.start.goals[arm.0].as_vec3().to_array());
        }
        let meets = layout.arms().all(|arm| runner.task.arm_meets_conditions(arm, &observation));
        let positions: Vec<DVec3> = now.iter().map(|now| now.object).collect();
        let misplaced: Vec<bool> = runner.misplaced(&objects, self.start).collect();
        state.progress.see(&positions, &misplaced);
        state.count_done(&now, &self.start.goals, runner.tolerance_m(), meets);
        let shares_object = runner.task.shares_object();
        let holds = |arm| shares_object && runner.task.arm_holds(arm, &observation);
        state.holds = layout.arms().map(holds).collect();
        let blocks = runner.observed_blocks(&objects, self.start.shared.as_ref());
        if self.withdraw(&blocks)? {
            return Ok(false);
        }
        let wanted = self.wanted_step(&now, [&observation, &goal], &blocks);
        self.move_hands(&wanted)
    }

    /// Returns what the policy wants for `observation` and `goal`, with the changes that spare the objects and keep
    /// parked arms where they are.
    fn wanted_step<'b>(
        &mut self,
        now: &[ArmObservation],
        [observation, goal]: [&[f32]; 2],
        blocks: &'b [ObservedBlock],
    ) -> WantedStep<'b> {
        let (runner, state) = (self.runner, &mut self.state);
        let layout = runner.config.layout;
        let mut action = vec![0.0; layout.n_action()];
        self.policy.act(observation, goal, &mut action);
        state.explore(&mut action);
        let mut wanted = WantedStep { hands: Vec::new(), openings_m: Vec::new(), blocks };
        for arm in layout.arms() {
            let action = &action[layout.action_of(arm)];
            let commanded_m = state.openings_m[arm.0];
            let opening_m = runner.mapping.opening_after(commanded_m, now[arm.0].opening_m, action);
            let velocity = &mut state.velocities[arm.0];
            let (hand, then) = runner.mapping.hand_after(now[arm.0].hand, *velocity, action);
            *velocity = then;
            wanted.hands.push(hand);
            wanted.openings_m.push(opening_m);
        }
        runner.spare_objects(state, now, &self.start.goals, &mut wanted);
        runner.keep_parked(state, &mut wanted);
        wanted
    }
}

impl TrialRunner {
    /// Returns the blocks at the observed poses; of a shared object, its parts by the poses of the arms' points.
    fn observed_blocks(
        &self,
        objects: &[ObjectPose],
        shared: Option<&SharedObject>,
    ) -> Vec<ObservedBlock> {
        let yaw_rad = |object: &ObjectPose| object.orientation.to_euler(EulerRot::ZYX).0;
        let Some(shared) = shared else {
            let half_m = DVec3::splat(self.config.block.half_m.into());
            let block = |object: &ObjectPose| ObservedBlock {
                position: object.at_m,
                yaw_rad: yaw_rad(object),
                half_m,
            };
            return objects.iter().map(block).collect();
        };
        let double = |numbers: [f32; 3]| DVec3::from_array(numbers.map(f64::from));
        // Each part is nearest to the point of one arm, whose observed pose places it best.
        let block = |part: &Cuboid| {
            let offset = |arm: usize| double(part.centre) - double(shared.points_m[arm]);
            let nearer = |a: &usize, b: &usize| {
                offset(*a).length_squared().total_cmp(&offset(*b).length_squared())
            };
            let arm = (0..objects.len()).min_by(nearer).unwrap_or(0);
            let object = &objects[arm];
            ObservedBlock {
                position: object.at_m + object.orientation * offset(arm),
                yaw_rad: yaw_rad(object),
                half_m: double(part.half_extents_m),
            }
        };
        shared.shown.iter().map(block).collect()
    }
}

impl LoopState {
    /// The state at the start of a trial, at `joint_angles`, radians.
    fn new(start: &TrialStart, joint_angles: &[Joints]) -> Self {
        Self {
            joint_angles: joint_angles.to_vec(),
            openings_m: vec![start.opening_m; joint_angles.len()],
            velocities: vec![DVec3::ZERO; joint_angles.len()],
            before: None,
            n_done: 0,
            n_in_success: 0,
            holds: vec![false; joint_angles.len()],
            progress: Progress::new(joint_angles.len()),
            narrow: vec![false; joint_angles.len()],
            withdraw: None,
            parked: vec![false; joint_angles.len()],
            n_waits: 0,
            noise: None,
            waypoints: Vec::new(),
        }
    }

    /// Appends a step's waypoints. The first one is the previous position of the tools.
    fn append_waypoints(&mut self, step: [Waypoint; 5]) {
        let n_known = usize::from(!self.waypoints.is_empty());
        self.waypoints.extend(step.into_iter().skip(n_known));
    }

    /// Returns whether an arm holds an object that all arms share.
    fn carries(&self) -> bool {
        self.holds.contains(&true)
    }

    /// Returns whether all arms hold the object that they share.
    fn all_hold(&self) -> bool {
        self.holds.iter().all(|holds| *holds)
    }

    fn count_success(&mut self, is_success: bool) {
        self.n_in_success = if is_success { self.n_in_success + 1 } else { 0 };
    }

    /// Counts an observation in which all arms met the task's conditions or not, as `meets` says.
    fn count_done(
        &mut self,
        now: &[ArmObservation],
        goals: &[DVec3],
        tolerance_m: f64,
        meets: bool,
    ) {
        let near_m = DONE_SHARE * tolerance_m;
        let done = meets
            && now.iter().zip(goals).all(|(now, goal)| (now.object - *goal).length() <= near_m);
        self.n_done = if done { self.n_done + 1 } else { 0 };
    }
}
