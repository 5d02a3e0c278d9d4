//! The environment: reset, observe, step.

use rand_chacha::ChaCha8Rng;
use rapier3d::math::Vector;
use tandem_core::scene::{Point, Scene};
use tandem_core::{ArmIndex, Contacts, Layout, WorldSettings};

use crate::arm::Command;
use crate::config::{SimError, WorldConfig};
use crate::description::{WorldDescription, describe};
use crate::frame::MAX_ARMS;
use crate::observation::observe_arm;
use crate::randomization::{DomainRandomization, ObservationNoise};
use crate::scene::scene;
use crate::start::{ArmStart, goal_area, sample_starts};
use crate::world::PhysicsWorld;

/// Smallest gap between the links of two arms at the start of an episode, metres.
const START_LINK_GAP_M: f32 = 0.02;
/// Half edge up to which cubes are clear of the hands in all drawn starts, metres.
const CLEAR_OBJECT_HALF_M: f32 = 0.036;
/// Smallest gap between a hand and a larger cube at the start of an episode, metres.
const START_HAND_GAP_M: f32 = 0.002;

/// One of the environments: push or pick and place, with one arm or two, in the classic or the shared world, or two
/// arms that carry a bar in the slow world.
///
/// An episode is a function of the random numbers passed to [`reset`](Self::reset) and of the actions, bit for bit. It
/// depends neither on earlier episodes nor on the thread.
///
/// Call [`reset`](Self::reset) before the first step. The environment has no time limit of its own: an episode lasts
/// [`EPISODE_STEPS`](tandem_core::layout::EPISODE_STEPS) steps by convention. It computes no rewards either; see
/// [`tandem_core::reward`].
#[derive(Clone)]
pub struct Env {
    layout: Layout,
    config: WorldConfig,
    /// A world that is never stepped: the state of rapier's caches after a step would affect the next episode.
    prototype: PhysicsWorld,
    world: PhysicsWorld,
    /// Shape `[n_goal]`, arm frames, metres.
    goal: Vec<f32>,
    n_steps: u32,
    object_half_m: f32,
    noise: Option<ObservationNoise>,
}

impl Env {
    /// Creates the environment of `layout`.
    ///
    /// # Errors
    /// Returns an error if `layout` does not have one or two arms, or fewer than its task takes, or if a value of
    /// `config` is out of range.
    pub fn new(layout: Layout, config: &WorldConfig) -> Result<Self, SimError> {
        if !(1..=MAX_ARMS).contains(&layout.n_arms) {
            return Err(SimError::Arms(layout.n_arms));
        }
        let (task, got, expected) = (layout.task, layout.n_arms, layout.task.min_arms());
        if got < expected {
            return Err(SimError::TooFewArms { task, got, expected });
        }
        let config = config.clone().checked()?;
        let prototype = PhysicsWorld::build(layout, &config);
        Ok(Self {
            layout,
            world: prototype.clone(),
            prototype,
            goal: vec![0.0; layout.n_goal()],
            n_steps: 0,
            object_half_m: config.object_half_size_m,
            noise: None,
            config,
        })
    }

    /// Returns the task and the number of arms.
    #[must_use]
    pub fn layout(&self) -> Layout {
        self.layout
    }

    /// Starts an episode with random positions of hands and objects and with random goals.
    ///
    /// All bodies are at rest. An object touches nothing but the table or, in a grasped start, the fingers that hold
    /// it. If `randomization` of `settings` is not 0, the properties of the episode's world are drawn first: size and
    /// mass of the objects, friction, a delay of up to 40 ms before an action takes effect, errors of observed
    /// positions and, in the shared world, the margin of contacts. `substeps` has no effect: the resolution of the
    /// physics is that of the [`WorldConfig`]. `settings` must be [checked](WorldSettings::check).
    pub fn reset(&mut self, rng: &mut ChaCha8Rng, settings: WorldSettings) {
        self.world = self.prototype.clone();
        self.n_steps = 0;
        self.object_half_m = self.config.object_half_size_m;
        self.noise = None;
        if settings.randomization > 0.0 {
            let (task, strength) = (self.layout.task, settings.randomization);
            let drawn = DomainRandomization::draw(rng, task, &self.config, strength);
            self.world.vary(&drawn);
            self.object_half_m = drawn.object_half_m;
            self.noise = Some(ObservationNoise::draw(rng, strength));
        }
        loop {
            let arms = sample_starts(rng, self.layout, self.object_half_m, settings);
            self.place(&arms);
            if self.world.link_gap_m() >= START_LINK_GAP_M && self.has_clear_hands(&arms) {
                return;
            }
        }
    }

    /// Writes the current observation, shape `[n_observation]`: 28 numbers per arm, in arm order, each in the arm's
    /// frame.
    ///
    /// | numbers | quantity | unit |
    /// |---|---|---|
    /// | 0–2 | position of the end effector | m |
    /// | 3–5 | position of the object | m |
    /// | 6–8 | position of the object relative to the end effector | m |
    /// | 9–11 | openings of the fingers | m |
    /// | 12–15 | orientation of the object in the arm's frame, quaternion (x, y, z, w) with w ≥ 0 | – |
    /// | 16–18 | velocity of the object relative to the end effector | m per control step |
    /// | 19–21 | angular velocity of the object | rad per control step |
    /// | 22–24 | velocity of the end effector | m per control step |
    /// | 25–27 | rates of the openings | m per control step |
    ///
    /// A gripper of the shared world has two fingers: numbers 9 and 10, and 25 and 26, are those of the same one.
    /// Openings are 0 in tasks without grasping, whose gripper is locked.
    ///
    /// In episodes with `randomization`, numbers 3–8 have errors of a few millimetres, drawn per episode and per step.
    /// What is computed from them, such as the achieved goal, has them too.
    ///
    /// # Panics
    /// If `observation` does not have length `n_observation`.
    pub fn observe(&self, observation: &mut [f32]) {
        assert_eq!(observation.len(), self.layout.n_observation(), "length of the observation");
        for arm in self.layout.arms() {
            let error = self.noise.as_ref().map_or(Vector::ZERO, |noise| noise.error(arm));
            observe_arm(&self.world, arm, error, &mut observation[self.layout.observation_of(arm)]);
        }
    }

    /// Returns the goal positions of the objects, in arm order, each in the arm's frame, metres, shape `[n_goal]`;
    /// zeros before the first reset.
    #[must_use]
    pub fn goal(&self) -> &[f32] {
        &self.goal
    }

    /// Returns the box that contains the goals of all episodes, in the frame of an arm: the range along each axis,
    /// metres.
    #[must_use]
    pub fn goal_area(&self) -> [[f32; 2]; 3] {
        goal_area(self.layout, self.object_half_m)
    }

    /// Moves the goal of `arm`'s object to `goal`, world frame, metres, or to the nearest point along each axis of the
    /// [`goal_area`](Self::goal_area). It does not affect the physics.
    ///
    /// # Panics
    /// If the world has no such arm.
    pub fn move_goal(&mut self, arm: ArmIndex, goal: Point) {
        let in_arm = self.world.arms[arm.0].frame.arm_from_world(Vector::from_array(goal));
        let [low, high] =
            [0, 1].map(|end| Vector::from_array(self.goal_area().map(|range| range[end])));
        let in_area = in_arm.clamp(low, high).to_array();
        self.goal[self.layout.goal_of(arm)].copy_from_slice(&in_area);
    }

    /// Executes `action` for one [control step](tandem_core::World::control_step_s) and returns the contacts of the
    /// arms during it.
    ///
    /// `action` has shape `[n_action]`, in arm frames, and is clamped to [−1, 1]. Each arm's part is a displacement of
    /// the end effector along x, y and z in units of 5 cm and, in tasks of grasping, the gripper's input: positive
    /// values open the gripper, −1 closes it and holds.
    ///
    /// Two arms are in contact if palms, wrists or fingers press on each other in any physics step, or if the gap
    /// between a link and a part of the other arm falls below zero. In episodes of the shared world with
    /// `randomization`, a gap below a margin of up to 2 cm, drawn with the episode, counts as a contact, between hands
    /// too. An arm is in contact with the table if palm, wrist or fingers press on it; the links stay high above it.
    /// The workspace ends 2 mm above the table, 16 mm in the shared world, so an arm touches the table only if it is
    /// pushed down. Only the shared world says which arm it was. In the shared world an arm is also in contact with the
    /// table while its hand presses an object onto it with more than 10 N: arms whose torques are supervised stop
    /// there.
    ///
    /// # Errors
    /// Returns an error if `action` has the wrong length or contains a number that is not finite; the state is then
    /// unchanged. Also returns an error if the physics produces such a number; reset the environment before the next
    /// step.
    pub fn step(&mut self, action: &[f32]) -> Result<Contacts, SimError> {
        let commands = self.commands(action)?;
        self.n_steps += 1;
        if let Some(noise) = &mut self.noise {
            noise.advance();
        }
        self.world.step(&commands)
    }

    /// Returns true if the pads of `arm` pressed on the bar from both sides in a physics step of the last control step;
    /// false in tasks without a bar.
    ///
    /// # Panics
    /// If the world has no such arm.
    #[must_use]
    pub fn is_gripping(&self, arm: ArmIndex) -> bool {
        self.world.is_gripping(arm)
    }

    /// Returns the number of physics steps of the last control step in which link avoidance changed the velocity of an
    /// arm. There are [`WorldConfig::substeps`] of them in a control step of the classic world and 4 times as many in
    /// the other ones.
    #[must_use]
    pub fn n_avoiding_substeps(&self) -> u32 {
        self.world.n_avoiding_substeps()
    }

    /// Returns a snapshot of all bodies, world frame. It does not affect the simulation.
    #[must_use]
    pub fn scene(&self) -> Scene {
        let time_s = f64::from(self.n_steps) / self.world.parameters.control_steps_per_s;
        scene(&self.world, self.layout, &self.goal, self.object_half_m, time_s)
    }

    /// Returns the bodies, their shapes and the control law as data, so that another physics engine can simulate the
    /// same world.
    #[must_use]
    pub fn description(&self) -> WorldDescription {
        describe(&self.prototype, self.layout, &self.config)
    }

    fn place(&mut self, arms: &[ArmStart]) {
        for (arm, start) in self.layout.arms().zip(arms) {
            self.world.place_arm(arm, start.end_effector, start.opening_m);
            if !self.world.has_bar {
                self.world.place_object(arm, start.object, start.object_yaw_rad);
            }
            self.goal[self.layout.goal_of(arm)].copy_from_slice(&start.goal.to_array());
        }
        if self.world.has_bar
            && let [first, second] = arms
        {
            self.world.place_bar([first.object, second.object], first.object_yaw_rad);
        }
        self.world.reset_link_avoidance();
        self.world.hold();
    }

    /// Returns true if no hand is at a cube that it does not hold. For cubes of the sizes in training, this follows
    /// from the distances in drawn starts; a hand that tilts can reach larger ones.
    fn has_clear_hands(&self, starts: &[ArmStart]) -> bool {
        if self.object_half_m <= CLEAR_OBJECT_HALF_M || self.world.has_bar {
            return true;
        }
        self.layout.arms().zip(starts).all(|(arm, start)| {
            self.layout.arms().all(|owner| {
                let is_held = start.holds_object && owner == arm;
                is_held || self.world.hand_to_object_m(arm, owner) >= START_HAND_GAP_M
            })
        })
    }

    fn commands(&self, action: &[f32]) -> Result<[Command; MAX_ARMS], SimError> {
        let expected = self.layout.n_action();
        if action.len() != expected {
            return Err(SimError::ActionLength { got: action.len(), expected });
        }
        if let Some(index) = action.iter().position(|value| !value.is_finite()) {
            return Err(SimError::ActionNotFinite { index, value: action[index] });
        }
        let mut commands = [Command { target: Vector::ZERO, gripper: 0.0 }; MAX_ARMS];
        for (arm, command) in self.layout.arms().zip(&mut commands) {
            *command = self.command(arm, &action[self.layout.action_of(arm)]);
        }
        Ok(commands)
    }

    fn command(&self, arm: ArmIndex, action: &[f32]) -> Command {
        let displacement = Vector::from_slice(action).clamp(Vector::NEG_ONE, Vector::ONE);
        let gripper = if self.layout.task.grasps() { action[3].clamp(-1.0, 1.0) } else { -1.0 };
        Command {
            target: self.world.arms[arm.0].target(&self.world.physics, displacement),
            gripper,
        }
    }
}

#[cfg(test)]
mod tests;
