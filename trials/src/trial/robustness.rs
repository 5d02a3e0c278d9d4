//! Rehearsed motions that also succeed where the arms' world differs from the training world.
//!
//! A motion without feedback cannot react to the differences between the world of its rehearsal and the one of its
//! execution. Each variant but the first, which is the training world itself, differs in friction or mass, and its
//! hands are displaced by a few millimetres. In more than half of them the pads that grasp are of rubber.

use rand_chacha::ChaCha8Rng;
use tandem_core::{ArmIndex, Contacts, Layout, TaskSpec, WorldSettings};
use tandem_sim::{Env, Friction, SimError, WorldConfig};

use crate::trial::rehearsal::{Rollout, goal_distances_m};

/// Factor from the friction of the pads that grasp in the training world, 0.45, to that of rubber pads, 0.8.
const RUBBER_FACTOR: f32 = 1.8;
/// The differences of each variant.
const DIFFERENCES: [Difference; 9] = [
    Difference { friction: 1.0, pads: 1.0, mass: 1.0, offset_m: [0.0, 0.0] },
    Difference { friction: 0.8, pads: RUBBER_FACTOR, mass: 1.0, offset_m: [0.003, 0.0] },
    Difference { friction: 1.2, pads: 1.0, mass: 1.0, offset_m: [-0.003, 0.0] },
    Difference { friction: 0.8, pads: RUBBER_FACTOR, mass: 1.0, offset_m: [0.0, 0.003] },
    Difference { friction: 1.2, pads: 1.0, mass: 1.0, offset_m: [0.0, -0.003] },
    Difference { friction: 1.2, pads: RUBBER_FACTOR, mass: 0.8, offset_m: [0.004, 0.004] },
    Difference { friction: 0.8, pads: RUBBER_FACTOR, mass: 1.2, offset_m: [-0.004, 0.004] },
    Difference { friction: 1.0, pads: 1.0, mass: 1.2, offset_m: [-0.004, -0.004] },
    Difference { friction: 1.0, pads: RUBBER_FACTOR, mass: 0.8, offset_m: [0.004, -0.004] },
];
/// Share of the tolerance within which a robust motion brings the objects to their goals.
pub(super) const USED_TOLERANCE_SHARE: f64 = 0.8;

/// The difference between a variant and the training world.
struct Difference {
    /// Factor of all friction coefficients.
    friction: f32,
    /// Further factor of the friction of pads that grasp.
    pads: f32,
    /// Factor of the objects' masses.
    mass: f32,
    /// Displacement of the hands along x and y, frame of the first arm, metres. That of the second one is rotated by
    /// 180°.
    offset_m: [f32; 2],
}

/// A world that differs from the training world.
struct Variant {
    env: Env,
    /// Displacement of the hands along x and y, frame of the first arm, as a share of an action's.
    offset: [f32; 2],
}

/// The variants of a training world, at the start of an episode.
pub(super) struct Variants {
    layout: Layout,
    worlds: Vec<Variant>,
}

impl Variants {
    /// Creates the variants of the world of `layout` with `config` and actions that move a hand by `action_m` metres.
    pub(super) fn new(
        layout: Layout,
        config: &WorldConfig,
        action_m: f32,
    ) -> Result<Self, SimError> {
        let variant = |difference: &Difference| {
            let env = Env::new(layout, &difference.applied_to(config))?;
            Ok(Variant { env, offset: difference.offset_m.map(|offset_m| offset_m / action_m) })
        };
        let worlds = DIFFERENCES.iter().map(variant).collect::<Result<_, SimError>>()?;
        Ok(Self { layout, worlds })
    }

    /// Starts the episode of which `rng` draws the start.
    pub(super) fn reset(&mut self, rng: &ChaCha8Rng) {
        for variant in &mut self.worlds {
            variant.env.reset(&mut rng.clone(), WorldSettings::default());
        }
    }

    /// Executes the actions of `rollout` in the variants. Returns the number of those in which they fail or lead to
    /// contacts, or `None` if they are more than `max_failed`.
    pub(super) fn n_failed(
        &self,
        rollout: &Rollout,
        max_failed: usize,
    ) -> Result<Option<usize>, SimError> {
        let mut n_failed = 0;
        for variant in &self.worlds {
            n_failed += usize::from(!self.succeeds(variant, rollout)?);
            if n_failed > max_failed {
                return Ok(None);
            }
        }
        Ok(Some(n_failed))
    }

    /// Returns whether the actions succeed without contacts.
    fn succeeds(&self, variant: &Variant, rollout: &Rollout) -> Result<bool, SimError> {
        let (env, contacts) = self.executed(variant, rollout)?;
        let mut observation = vec![0.0; self.layout.n_observation()];
        env.observe(&mut observation);
        let distance_m = goal_distances_m(&env, &observation).into_iter().fold(0.0, f64::max);
        let task = TaskSpec::from(self.layout);
        Ok(task.is_success(&observation, env.goal())
            && distance_m <= USED_TOLERANCE_SHARE * f64::from(task.tolerance())
            && contacts == Contacts::NONE)
    }

    /// Displaces the hands, in a step of its own, and then executes the actions. The first action has no room for the
    /// displacement where it moves a hand as far as possible.
    fn executed(&self, variant: &Variant, rollout: &Rollout) -> Result<(Env, Contacts), SimError> {
        let mut env = variant.env.clone();
        let mut contacts = env.step(&self.displacement(variant))?;
        for step in &rollout.steps {
            contacts = contacts | env.step(&step.action)?;
        }
        Ok((env, contacts))
    }

    /// Returns the action that displaces the hands of `variant`, shape `[n_action]`.
    fn displacement(&self, variant: &Variant) -> Vec<f32> {
        let mut action = vec![0.0; self.layout.n_action()];
        for arm in self.layout.arms() {
            let first = self.layout.action_of(arm).start;
            let sign = if arm == ArmIndex(0) { 1.0 } else { -1.0 };
            for (axis, offset) in variant.offset.iter().enumerate() {
                action[first + axis] = sign * offset;
            }
        }
        action
    }
}

impl Difference {
    fn applied_to(&self, config: &WorldConfig) -> WorldConfig {
        let times = |value: f32| value * self.friction;
        let surfaces = |friction: Friction| Friction {
            pads: times(friction.pads),
            object: times(friction.object),
        };
        let grasping = surfaces(config.pick_and_place);
        WorldConfig {
            object_mass_kg: config.object_mass_kg * self.mass,
            table_friction: times(config.table_friction),
            push: surfaces(config.push),
            pick_and_place: Friction { pads: grasping.pads * self.pads, ..grasping },
            carry_bar: surfaces(config.carry_bar),
            rubber_pads: times(config.rubber_pads),
            ..config.clone()
        }
    }
}

#[cfg(test)]
mod tests {
    use tandem_core::{Stream, Task, episode_rng};

    use super::*;
    use crate::trial::rehearsal::RolloutStep;

    fn started(layout: Layout) -> (Env, Variants) {
        let config = WorldConfig::default();
        let mut env = Env::new(layout, &config).unwrap();
        let action_m = env.description().hand.action_m;
        let mut variants = Variants::new(layout, &config, action_m).unwrap();
        let rng = episode_rng(1, 2, Stream::Reset);
        env.reset(&mut rng.clone(), WorldSettings::default());
        variants.reset(&rng);
        (env, variants)
    }

    fn observed(env: &Env) -> Vec<f32> {
        let mut observation = vec![0.0; env.layout().n_observation()];
        env.observe(&mut observation);
        observation
    }

    #[test]
    fn variants_start_like_the_training_world() {
        for task in [Task::Push, Task::SharedPickAndPlace, Task::CarryBar] {
            let (env, variants) = started(Layout::new(task, 2));
            for variant in &variants.worlds {
                assert_eq!(observed(&variant.env), observed(&env), "{task}");
                assert_eq!(variant.env.goal(), env.goal(), "{task}");
            }
        }
    }

    /// Returns an episode in which the hands move along x by `actions_x`, one number per step.
    fn rollout(layout: Layout, actions_x: &[f32]) -> Rollout {
        let step = |x: &f32| {
            let mut action = vec![0.0; layout.n_action()];
            for arm in layout.arms() {
                action[layout.action_of(arm).start] = *x;
            }
            RolloutStep { hands: Vec::new(), openings_m: Vec::new(), action }
        };
        Rollout {
            steps: actions_x.iter().map(step).collect(),
            goal_distances_m: vec![0.0; layout.n_arms],
            contacts: Contacts::NONE,
        }
    }

    #[test]
    fn idle_hands_fail_everywhere() {
        let layout = Layout::new(Task::SharedPush, 2);
        let (_, variants) = started(layout);
        let idle = rollout(layout, &[0.0; 6]);
        assert_eq!(variants.n_failed(&idle, usize::MAX).unwrap(), Some(DIFFERENCES.len()));
        assert_eq!(variants.n_failed(&idle, 3).unwrap(), None);
    }

    #[test]
    fn hands_are_displaced_whatever_the_first_actions() {
        let layout = Layout::new(Task::SharedPickAndPlace, 2);
        let (_, variants) = started(layout);
        let second = layout.observation_of(ArmIndex(1)).start;
        for first in [0.0, 1.0, -1.0] {
            let moves = rollout(layout, &[first, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
            let (plain, _) = variants.executed(&variants.worlds[0], &moves).unwrap();
            let plain = observed(&plain);
            for (variant, difference) in variants.worlds.iter().zip(&DIFFERENCES) {
                let (displaced, _) = variants.executed(variant, &moves).unwrap();
                let displaced = observed(&displaced);
                for (axis, offset_m) in difference.offset_m.into_iter().enumerate() {
                    for (at, offset_m) in [(axis, offset_m), (second + axis, -offset_m)] {
                        let by_m = displaced[at] - plain[at];
                        assert!((by_m - offset_m).abs() < 5e-4, "{first}: {by_m} m");
                    }
                }
            }
        }
    }

    #[test]
    fn variants_differ_in_friction_and_mass() {
        let config = WorldConfig::default();
        let changed = DIFFERENCES[7].applied_to(&config);
        assert_eq!(changed.object_mass_kg, config.object_mass_kg * 1.2);
        let slippery = DIFFERENCES[1].applied_to(&config);
        assert_eq!(slippery.table_friction, config.table_friction * 0.8);
        assert_eq!(slippery.pick_and_place.object, config.pick_and_place.object * 0.8);
        let pads = [0, 1].map(|idx| DIFFERENCES[idx].applied_to(&config).pick_and_place.pads);
        assert_eq!(
            pads,
            [config.pick_and_place.pads, config.pick_and_place.pads * 0.8 * RUBBER_FACTOR]
        );
        assert_eq!(slippery.rubber_pads, config.rubber_pads * 0.8);
    }
}
