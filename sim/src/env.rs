//! The environment: start, observe, act.

use rand_chacha::ChaCha8Rng;
use rapier3d::math::Vector;
use tandem_core::scene::Scene;
use tandem_core::{ArmIndex, Contacts, Layout, Task};

use crate::arm::Command;
use crate::config::{CONTROL_STEPS_PER_S, SimError, Starts, WorldConfig};
use crate::observation::observe_arm;
use crate::scene::scene;
use crate::start::{ArmStart, draw};
use crate::world::{MAX_ARMS, World};

/// Least gap between two arms' links at the start of an episode, metres.
const START_LINK_GAP_M: f32 = 0.02;

/// One of the four environments: push or pick and place, by one arm or two.
///
/// What happens is a function of the random numbers given to [`reset`](Self::reset) and of the actions, bit for bit,
/// whatever the environment was used for before and whichever thread it runs on.
///
/// A new environment has to be [`reset`](Self::reset) before its first step.
#[derive(Clone)]
pub struct Env {
    layout: Layout,
    object_half_m: f32,
    /// A world that is never stepped: what a world leaves behind in rapier's caches would enter the next episode.
    prototype: World,
    world: World,
    /// Shape `[n_goal]`, own frames, metres.
    goal: Vec<f32>,
    n_steps: u32,
}

impl Env {
    /// Builds the world of `layout`.
    ///
    /// # Errors
    /// When `layout` has neither one arm nor two, or a value of `config` is out of its range.
    pub fn new(layout: Layout, config: &WorldConfig) -> Result<Self, SimError> {
        if !(1..=MAX_ARMS).contains(&layout.n_arms) {
            return Err(SimError::Arms(layout.n_arms));
        }
        let config = config.clone().checked()?;
        let prototype = World::build(layout, &config);
        Ok(Self {
            layout,
            object_half_m: config.object_half_size_m,
            world: prototype.clone(),
            prototype,
            goal: vec![0.0; layout.n_goal()],
            n_steps: 0,
        })
    }

    /// Task and number of arms.
    #[must_use]
    pub fn layout(&self) -> Layout {
        self.layout
    }

    /// Starts an episode: everything at rest in random places and with random goals, nothing touching anything but
    /// the table or the fingers that hold it.
    pub fn reset(&mut self, rng: &mut ChaCha8Rng, starts: Starts) {
        self.world = self.prototype.clone();
        self.n_steps = 0;
        loop {
            let arms = draw(rng, self.layout, self.object_half_m, starts);
            self.place(&arms);
            if self.world.link_gap_m() >= START_LINK_GAP_M {
                return;
            }
        }
    }

    /// Writes what the arms see, arm after arm, each in its own frame, shape `[n_observation]`.
    ///
    /// # Panics
    /// When `observation` has another length.
    pub fn observe(&self, observation: &mut [f32]) {
        assert_eq!(observation.len(), self.layout.n_observation(), "observation of another layout");
        for arm in self.layout.arms() {
            observe_arm(&self.world, arm, &mut observation[self.layout.observation_of(arm)]);
        }
    }

    /// Where the objects shall be, arm after arm, each in its own frame, metres, shape `[n_goal]`.
    #[must_use]
    pub fn goal(&self) -> &[f32] {
        &self.goal
    }

    /// Acts for one control step and tells which parts of the arms touched each other or the table in it.
    ///
    /// `action` has shape `[n_action]`, own frames, and is cut to [−1, 1]: per arm three displacements of the end
    /// effector in units of 5 cm and, in pick and place, the gripper's input: positive opens, −1 closes and holds.
    ///
    /// # Errors
    /// When `action` has another length or a number that is not finite, or the step gave such a number. The
    /// environment then has to be reset.
    pub fn step(&mut self, action: &[f32]) -> Result<Contacts, SimError> {
        let commands = self.commands(action)?;
        self.n_steps += 1;
        self.world.step(&commands)
    }

    /// What the world looks like now, in the world's frame. Looking changes nothing.
    #[must_use]
    pub fn scene(&self) -> Scene {
        let time_s = f64::from(self.n_steps) / CONTROL_STEPS_PER_S;
        scene(&self.world, self.layout, &self.goal, self.object_half_m, time_s)
    }

    fn place(&mut self, arms: &[ArmStart]) {
        for (arm, start) in self.layout.arms().zip(arms) {
            self.world.place_arm(arm, start.end_effector, start.opening_m);
            self.world.place_object(arm, start.object);
            self.goal[self.layout.goal_of(arm)].copy_from_slice(&start.goal.to_array());
        }
        self.world.arm_guard();
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
        let gripper = match self.layout.task {
            Task::Push => -1.0,
            Task::PickAndPlace => action[3].clamp(-1.0, 1.0),
        };
        Command { target: self.world.arms[arm.0].target(&self.world.physics, displacement), gripper }
    }
}
