//! Properties of the world that vary between episodes.

use rand::RngExt as _;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng as _;
use rapier3d::math::Vector;
use tandem_core::rng::{standard_normal, uniform};
use tandem_core::{ArmIndex, Task, World};

use crate::config::{Surfaces, WorldConfig};
use crate::frame::MAX_ARMS;

/// Edge of the cubes, metres.
const OBJECT_EDGE_M: [f32; 2] = [0.045, 0.065];
/// Mass of the cubes, kilograms.
const OBJECT_MASS_KG: [f32; 2] = [0.05, 0.20];
/// Friction of the table.
const TABLE: [f32; 2] = [0.4, 0.8];
/// Friction of pads and cubes as a multiple of the configured one, at the configured friction of the table. The tips of
/// pads, which press from above, have less friction than the table, so they cannot drag a cube.
const SURFACES: [f32; 2] = [0.7, 1.25];
/// Time until an action takes effect, seconds.
const DELAY_S: [f32; 2] = [0.0, 0.040];
/// Largest constant error of an object's observed position along each axis, metres.
const PLACE_ERROR_M: f32 = 0.002;
/// Standard deviation of the error that changes with each step along each axis, metres.
const PLACE_NOISE_M: f32 = 0.001;

/// Gap between two arms of the shared world below which they count as touching, metres: up to the gap that the check of the
/// bridge demands. An arm cannot know it, so it expects the more contacts the nearer it comes to the other one.
const CONTACT_MARGIN_M: [f32; 2] = [0.0, 0.02];

/// The properties of one episode's world, drawn around those that are configured.
pub(crate) struct DomainRandomization {
    pub(crate) object_half_m: f32,
    pub(crate) object_mass_kg: f32,
    pub(crate) surfaces: Surfaces,
    pub(crate) table_friction: f32,
    pub(crate) delay_s: f32,
    pub(crate) contact_margin_m: f32,
}

/// Errors of the observed positions of objects.
#[derive(Clone)]
pub(crate) struct ObservationNoise {
    rng: ChaCha8Rng,
    strength: f32,
    /// Errors of the whole episode, arm frames, metres.
    constant: [Vector; MAX_ARMS],
    /// Errors of the current step, arm frames, metres.
    current: [Vector; MAX_ARMS],
}

impl DomainRandomization {
    /// Draws the properties. `strength` of 0 gives those of `config`, 1 the full ranges.
    pub(crate) fn draw(
        rng: &mut ChaCha8Rng,
        task: Task,
        config: &WorldConfig,
        strength: f32,
    ) -> Self {
        let mut between = |nominal: f32, [low, high]: [f32; 2]| {
            nominal + strength * (uniform(rng, low, high) - nominal)
        };
        let nominal = config.surfaces(task);
        let object_half_m =
            between(config.object_half_size_m, OBJECT_EDGE_M.map(|edge| 0.5 * edge));
        let object_mass_kg = between(config.object_mass_kg, OBJECT_MASS_KG);
        let table_friction = between(config.table_friction, TABLE);
        let factor = between(1.0, SURFACES) * table_friction / config.table_friction;
        let surfaces = Surfaces {
            sides: nominal.sides * factor,
            tips: nominal.tips * factor,
            object: nominal.object * factor,
        };
        let delay_s = between(0.0, DELAY_S);
        let contact_margin_m = match task.world() {
            World::Shared => between(0.0, CONTACT_MARGIN_M),
            World::Classic | World::Slow => 0.0,
        };
        Self { object_half_m, object_mass_kg, surfaces, table_friction, delay_s, contact_margin_m }
    }
}

impl ObservationNoise {
    /// Draws the errors of an episode. They have a generator of their own, which `rng` seeds.
    pub(crate) fn draw(rng: &mut ChaCha8Rng, strength: f32) -> Self {
        let mut rng = ChaCha8Rng::from_seed(rng.random());
        let largest_m = strength * PLACE_ERROR_M;
        let constant = [(); MAX_ARMS].map(|()| {
            Vector::from_array([(); 3].map(|()| uniform(&mut rng, -largest_m, largest_m)))
        });
        let mut noise = Self { rng, strength, constant, current: constant };
        noise.advance();
        noise
    }

    /// Draws the errors of the next step.
    pub(crate) fn advance(&mut self) {
        for (current, constant) in self.current.iter_mut().zip(self.constant) {
            let drawn = [(); 3].map(|()| standard_normal(&mut self.rng));
            *current = constant + Vector::from_array(drawn) * (self.strength * PLACE_NOISE_M);
        }
    }

    /// Returns the error of the observed position of `arm`'s object, arm frame, metres.
    pub(crate) fn error(&self, arm: ArmIndex) -> Vector {
        self.current[arm.0]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use tandem_core::{Stream, episode_rng};

    #[test]
    fn draws_stay_in_their_ranges_and_tips_have_less_friction_than_the_table() {
        let config = WorldConfig::default();
        for (task, number) in
            Task::ALL.into_iter().flat_map(|task| (0..500).map(move |n| (task, n)))
        {
            let mut rng = episode_rng(1, number, Stream::Reset);
            let drawn = DomainRandomization::draw(&mut rng, task, &config, 1.0);
            let within = |value: f32, [low, high]: [f32; 2]| (low..=high).contains(&value);
            assert!(within(2.0 * drawn.object_half_m, OBJECT_EDGE_M));
            assert!(within(drawn.object_mass_kg, OBJECT_MASS_KG));
            assert!(within(drawn.table_friction, TABLE));
            assert!(within(drawn.delay_s, DELAY_S));
            // A bar has rough handles.
            let can_drag = task.shares_object();
            assert!(can_drag || drawn.surfaces.tips < drawn.table_friction);
        }
    }

    #[test]
    fn a_strength_of_zero_is_the_configured_world() {
        let config = WorldConfig::default();
        let mut rng = episode_rng(1, 0, Stream::Reset);
        let drawn = DomainRandomization::draw(&mut rng, Task::SharedPush, &config, 0.0);
        assert_eq!(drawn.object_half_m, config.object_half_size_m);
        assert_eq!(drawn.object_mass_kg, config.object_mass_kg);
        assert_eq!(drawn.surfaces, config.surfaces(Task::SharedPush));
        assert_eq!((drawn.table_friction, drawn.delay_s), (config.table_friction, 0.0));
    }
}
