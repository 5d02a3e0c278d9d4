//! The environment: start, observe, act.

use rand_chacha::ChaCha8Rng;
use rapier3d::math::Vector;
use tandem_core::scene::Scene;
use tandem_core::{ArmIndex, Contacts, Layout, Task, WorldSettings};

use crate::arm::Command;
use crate::config::{CONTROL_STEPS_PER_S, SimError, WorldConfig};
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
    pub fn reset(&mut self, rng: &mut ChaCha8Rng, settings: WorldSettings) {
        self.world = self.prototype.clone();
        self.n_steps = 0;
        loop {
            let arms = draw(rng, self.layout, self.object_half_m, settings);
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
    /// Arms touch when palms, wrists or fingers press on each other in any physics step, or when the gap between a link
    /// and a part of the other arm falls below zero. An arm touches the table when palm, wrist or fingers press on it;
    /// the links stay 0.2 m above it, as the gripper points down. By itself an arm stops 2 mm above the table, so that
    /// takes being pushed down.
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
        Command {
            target: self.world.arms[arm.0].target(&self.world.physics, displacement),
            gripper,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frame::WORKSPACE_LOW;
    use crate::hand::{MAX_OPENING_M, PAD_HALF_M};
    use tandem_core::rng::uniform;
    use tandem_core::{Stream, episode_rng};

    const N_STEPS: usize = 12;
    const NUDGE_M: Vector = Vector::splat(1e-7);

    /// A vector of two arms with their halves in each other's place.
    fn swapped(both: &[f32]) -> Vec<f32> {
        let (first, second) = both.split_at(both.len() / 2);
        [second, first].concat()
    }

    /// What two arms see on the way from `arms`, each going for its own object with some noise.
    fn observations(env: &mut Env, arms: &[ArmStart], noise: &[Vec<f32>]) -> Vec<Vec<f32>> {
        env.world = env.prototype.clone();
        env.place(arms);
        let layout = env.layout;
        let mut observation = vec![0.0; layout.n_observation()];
        noise
            .iter()
            .map(|noise| {
                env.observe(&mut observation);
                let mut action = noise.clone();
                for arm in layout.arms() {
                    let to_object = &observation[layout.observation_of(arm)][6..9];
                    for (input, offset_m) in action[layout.action_of(arm)].iter_mut().zip(to_object)
                    {
                        *input += 10.0 * offset_m;
                    }
                }
                env.step(&action).unwrap();
                env.observe(&mut observation);
                observation.clone()
            })
            .collect()
    }

    /// Step by step, the largest difference of a place, of hands or objects, between two courses of events, metres.
    fn apart_m(layout: Layout, one: &[Vec<f32>], other: &[Vec<f32>]) -> Vec<f32> {
        let places: Vec<usize> =
            layout.arms().flat_map(|arm| layout.observation_of(arm).take(6)).collect();
        let largest = |one: &[f32], other: &[f32]| {
            places.iter().map(|&idx| (one[idx] - other[idx]).abs()).fold(0.0, f32::max)
        };
        one.iter().zip(other).map(|(one, other)| largest(one, other)).collect()
    }

    /// What nine of ten episodes do not exceed at `step`.
    fn usually_m(apart_m: &[Vec<f32>], step: usize) -> f32 {
        let mut sorted: Vec<f32> = apart_m.iter().map(|episode| episode[step]).collect();
        sorted.sort_by(f32::total_cmp);
        sorted[sorted.len() * 9 / 10]
    }

    fn world_of_two() -> World {
        World::build(Layout::new(Task::PickAndPlace, 2), &WorldConfig::default())
    }

    /// What touches when the hands, at `hands` in own frames, stay there for a control step.
    fn contacts_at(hands: [Vector; 2]) -> Contacts {
        let mut world = world_of_two();
        for (arm, hand) in [ArmIndex(0), ArmIndex(1)].into_iter().zip(hands) {
            world.place_arm(arm, hand, MAX_OPENING_M);
            world.place_object(arm, Vector::new(-0.1, 0.2, 0.0225));
        }
        world.arm_guard();
        let stay = world.arms.iter().map(|arm| arm.hand.end_effector(&world.physics));
        let commands: Vec<Command> = stay.map(|target| Command { target, gripper: 1.0 }).collect();
        world.step(&[commands[0], commands[1]]).unwrap()
    }

    #[test]
    fn contacts_of_hands_are_told_apart() {
        let high = Vector::new(0.0, 0.0, 0.15);
        assert_eq!(contacts_at([high, high]), Contacts::NONE);
        let lowest = Vector::new(0.0, 0.0, WORKSPACE_LOW.z);
        assert_eq!(
            contacts_at([lowest, lowest]),
            Contacts::NONE,
            "the workspace's floor keeps the pads off the table"
        );
        let on_table = Vector::new(0.0, 0.0, PAD_HALF_M.z - 0.001);
        assert_eq!(contacts_at([on_table, high]), Contacts::ARM_TABLE);
        assert_eq!(contacts_at([high, on_table]), Contacts::ARM_TABLE);
        let meeting = high + Vector::X * 0.09;
        assert_eq!(contacts_at([meeting, meeting]), Contacts::ARM_ARM);
    }

    /// Rounding grows by contact, so exactness shows only before the first one; after it the symmetry may be broken by
    /// no more than a displacement of the objects by 0.1 µm changes the course of events.
    #[test]
    fn swapping_the_arms_data_is_a_symmetry() {
        for task in Task::ALL {
            let layout = Layout::new(task, 2);
            let mut env = Env::new(layout, &WorldConfig::default()).unwrap();
            let (mut by_swapping, mut by_nudging) = (Vec::new(), Vec::new());
            for episode in 0..240 {
                let mut rng = episode_rng(2, episode, Stream::Reset);
                let settings =
                    WorldSettings { grasped_start_prob: 0.3, ..WorldSettings::default() };
                let [first, second] = draw(&mut rng, layout, env.object_half_m, settings)[..]
                else {
                    panic!()
                };
                let mut noise =
                    || (0..layout.n_action()).map(|_| uniform(&mut rng, -0.5, 0.5)).collect();
                let noise: Vec<Vec<f32>> = (0..N_STEPS).map(|_| noise()).collect();
                let noise_swapped: Vec<Vec<f32>> = noise.iter().map(|both| swapped(both)).collect();
                let nudged = [first, second]
                    .map(|start| ArmStart { object: start.object + NUDGE_M, ..start });

                let original = observations(&mut env, &[first, second], &noise);
                let mirrored = observations(&mut env, &[second, first], &noise_swapped);
                let mirrored: Vec<_> = mirrored.iter().map(|both| swapped(both)).collect();
                by_swapping.push(apart_m(layout, &original, &mirrored));
                by_nudging.push(apart_m(
                    layout,
                    &original,
                    &observations(&mut env, &nudged, &noise),
                ));
            }
            for step in 0..N_STEPS {
                let (swapping, nudging) =
                    (usually_m(&by_swapping, step), usually_m(&by_nudging, step));
                assert!(
                    swapping <= 1.5 * nudging,
                    "{task}, step {step}: {swapping} m apart, {nudging} m by a nudge"
                );
            }
            assert!(
                usually_m(&by_swapping, 0) < 5e-6,
                "{task}: {} m at once",
                usually_m(&by_swapping, 0)
            );
        }
    }
}
