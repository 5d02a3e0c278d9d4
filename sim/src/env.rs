//! The environment.

use rand_chacha::ChaCha8Rng;
use tandem_core::scene::{Cuboid, Scene};
use tandem_core::{Contacts, Layout};

use crate::config::{SimError, Starts, WorldConfig};

/// A world with a task.
#[derive(Clone)]
pub struct Env {
    layout: Layout,
    goal: Vec<f32>,
}

impl Env {
    /// Builds the world of `layout`.
    ///
    /// # Errors
    /// When `layout` has not 1 or 2 arms or a value of `config` is out of range.
    pub fn new(layout: Layout, config: &WorldConfig) -> Result<Self, SimError> {
        config.clone().checked()?;
        Ok(Self { layout, goal: vec![0.0; layout.n_goal()] })
    }

    /// Task and arms.
    #[must_use]
    pub fn layout(&self) -> Layout {
        self.layout
    }

    /// Draws a start and a goal.
    pub fn reset(&mut self, _rng: &mut ChaCha8Rng, _starts: Starts) {}

    /// Writes the observation, shape `[n_observation]`.
    pub fn observe(&self, observation: &mut [f32]) {
        observation.fill(0.0);
    }

    /// The desired goal, shape `[n_goal]`.
    #[must_use]
    pub fn goal(&self) -> &[f32] {
        &self.goal
    }

    /// Acts for one control step, shape `[n_action]`.
    ///
    /// # Errors
    /// When a number is not finite.
    pub fn step(&mut self, _action: &[f32]) -> Result<Contacts, SimError> {
        Ok(Contacts::NONE)
    }

    /// The world as it looks now.
    #[must_use]
    pub fn scene(&self) -> Scene {
        let table = Cuboid { centre: [0.0; 3], orientation: [0.0, 0.0, 0.0, 1.0], half_extents_m: [1.0; 3] };
        Scene { time_s: 0.0, arms: vec![], objects: vec![], goals: vec![], table }
    }
}
