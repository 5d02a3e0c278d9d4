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
use crate::randomization::{Episode, ObservationNoise};
use crate::scene::scene;
use crate::start::{ArmStart, goal_area, sample_starts};
use crate::world::World;

/// Smallest gap between the links of two arms at the start of an episode, metres.
const START_LINK_GAP_M: f32 = 0.02;

/// One of the environments: push or pick and place, with one arm or two, in either world, or two arms that carry a bar.
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
    prototype: World,
    world: World,
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
    /// Returns an error if `layout` does not have one or two arms, or if a value of `config` is out of range.
    pub fn new(layout: Layout, config: &WorldConfig) -> Result<Self, SimError> {
        if !(1..=MAX_ARMS).contains(&layout.n_arms) {
            return Err(SimError::Arms(layout.n_arms));
        }
        let (task, got, expected) = (layout.task, layout.n_arms, layout.task.min_arms());
        if got < expected {
            return Err(SimError::TooFewArms { task, got, expected });
        }
        let config = config.clone().checked()?;
        let prototype = World::build(layout, &config);
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
    /// it. If `randomization` of `settings` is not 0, the properties of the episode's world are drawn first. `substeps` has
    /// no effect: the resolution of the physics is that of the [`WorldConfig`].
    pub fn reset(&mut self, rng: &mut ChaCha8Rng, settings: WorldSettings) {
        self.world = self.prototype.clone();
        self.n_steps = 0;
        self.object_half_m = self.config.object_half_size_m;
        self.noise = None;
        if settings.randomization > 0.0 {
            let episode =
                Episode::draw(rng, self.layout.task, &self.config, settings.randomization);
            self.world.vary(&episode);
            self.object_half_m = episode.object_half_m;
            self.noise = Some(ObservationNoise::draw(rng, settings.randomization));
        }
        loop {
            let arms = sample_starts(rng, self.layout, self.object_half_m, settings);
            self.place(&arms);
            if self.world.link_gap_m() >= START_LINK_GAP_M {
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
    /// | 9–11 | openings of the three fingers | m |
    /// | 12–15 | orientation of the object, quaternion (x, y, z, w) with w ≥ 0 | – |
    /// | 16–18 | velocity of the object relative to the end effector | m per control step |
    /// | 19–21 | angular velocity of the object | rad per control step |
    /// | 22–24 | velocity of the end effector | m per control step |
    /// | 25–27 | rates of the openings | m per control step |
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

    /// Returns the goal positions of the objects, in arm order, each in the arm's frame, metres, shape `[n_goal]`.
    #[must_use]
    pub fn goal(&self) -> &[f32] {
        &self.goal
    }

    /// Returns the box that contains the goals of all episodes, in the frame of an arm: the range along each axis, metres.
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

    /// Executes `action` for one [control step](tandem_core::World::control_step_s) and returns the contacts of the arms
    /// during it.
    ///
    /// `action` has shape `[n_action]`, in arm frames, and is clamped to [−1, 1]. Each arm's part is a displacement of
    /// the end effector along x, y and z in units of 5 cm and, in pick and place, the gripper's input: positive values
    /// open the gripper, −1 closes it and holds.
    ///
    /// Two arms are in contact if palms, wrists or fingers press on each other in any physics step, or if the gap
    /// between a link and a part of the other arm falls below zero. An arm is in contact with the table if palm, wrist
    /// or fingers press on it; the links stay 0.2 m above it, as the gripper points down. The workspace ends 2 mm above
    /// the table, so an arm touches the table only if it is pushed down.
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
    /// the shared world.
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
mod tests {
    use tandem_core::Task;

    use super::*;
    use crate::hand::THREE_FINGERS;
    use crate::parameters::WorldParameters;
    use tandem_core::rng::uniform;
    use tandem_core::{Stream, TaskSpec, episode_rng};

    const N_STEPS: usize = 12;
    const ARM: ArmIndex = ArmIndex(0);
    const NUDGE_M: Vector = Vector::splat(1e-7);

    /// Exchanges the parts of the two arms in a vector.
    fn swapped(both: &[f32]) -> Vec<f32> {
        let (first, second) = both.split_at(both.len() / 2);
        [second, first].concat()
    }

    /// The observations of two arms that start at `arms` and approach their own objects with some noise.
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

    /// For each step the largest difference in a position of a hand or an object between two trajectories, metres.
    fn difference_m(layout: Layout, one: &[Vec<f32>], other: &[Vec<f32>]) -> Vec<f32> {
        let positions: Vec<usize> =
            layout.arms().flat_map(|arm| layout.observation_of(arm).take(6)).collect();
        let largest = |one: &[f32], other: &[f32]| {
            positions.iter().map(|&idx| (one[idx] - other[idx]).abs()).fold(0.0, f32::max)
        };
        one.iter().zip(other).map(|(one, other)| largest(one, other)).collect()
    }

    /// The 90th percentile over episodes of the difference at `step`.
    fn percentile_90_m(differences_m: &[Vec<f32>], step: usize) -> f32 {
        let mut sorted: Vec<f32> = differences_m.iter().map(|episode| episode[step]).collect();
        sorted.sort_by(f32::total_cmp);
        sorted[sorted.len() * 9 / 10]
    }

    fn world_of_two() -> World {
        World::build(Layout::new(Task::PickAndPlace, 2), &WorldConfig::default())
    }

    /// The contacts of hands that stay at `hands`, in arm frames, for a control step.
    fn contacts_at(hands: [Vector; 2]) -> Contacts {
        let mut world = world_of_two();
        for (arm, hand) in [ArmIndex(0), ArmIndex(1)].into_iter().zip(hands) {
            world.place_arm(arm, hand, THREE_FINGERS.max_opening_m);
            world.place_object(arm, Vector::new(-0.1, 0.2, 0.0225), 0.0);
        }
        world.reset_link_avoidance();
        let stay = world.arms.iter().map(|arm| arm.hand.end_effector(&world.physics));
        let commands: Vec<Command> = stay.map(|target| Command { target, gripper: 1.0 }).collect();
        world.step(&[commands[0], commands[1]]).unwrap()
    }

    #[test]
    fn a_goal_moves_to_the_nearest_point_of_its_area() {
        let mut env =
            Env::new(Layout::new(Task::PickAndPlace, 2), &WorldConfig::default()).unwrap();
        env.reset(&mut episode_rng(1, 0, Stream::Reset), WorldSettings::default());
        let other = env.goal()[..3].to_vec();
        env.move_goal(ArmIndex(1), [0.05, -0.5, 0.1]);
        assert_eq!(env.goal()[..3], other);
        let expected = [0.07, 0.12, 0.1];
        let near = |(got, expected): (&f32, f32)| (got - expected).abs() < 1e-6;
        assert!(env.goal()[3..].iter().zip(expected).all(near), "{:?}", env.goal());
        assert_eq!(env.scene().goals[1][1], -0.12);
        for episode in 0..20 {
            env.reset(&mut episode_rng(1, episode, Stream::Reset), WorldSettings::default());
            let (area, goals) = (env.goal_area(), env.goal().as_chunks::<3>().0);
            let is_inside = |goal: &[f32; 3]| {
                (0..3).all(|axis| (area[axis][0]..=area[axis][1]).contains(&goal[axis]))
            };
            assert!(goals.iter().all(is_inside), "{goals:?} outside {area:?}");
        }
    }

    #[test]
    fn contacts_between_hands_and_with_the_table_are_distinguished() {
        let high = Vector::new(0.0, 0.0, 0.15);
        assert_eq!(contacts_at([high, high]), Contacts::NONE);
        let lowest =
            Vector::new(0.0, 0.0, WorldParameters::of(tandem_core::World::Classic).workspace_low.z);
        assert_eq!(
            contacts_at([lowest, lowest]),
            Contacts::NONE,
            "the workspace's floor keeps the pads off the table"
        );
        let on_table = Vector::new(0.0, 0.0, THREE_FINGERS.pad_half.z - 0.001);
        assert_eq!(contacts_at([on_table, high]), Contacts::ARM_TABLE);
        assert_eq!(contacts_at([high, on_table]), Contacts::ARM_TABLE);
        let meeting = high + Vector::X * 0.09;
        assert_eq!(contacts_at([meeting, meeting]), Contacts::ARM_ARM);
    }

    /// For each step the 90th percentiles over episodes of the differences that swapping the arms and that displacing
    /// the objects by a tenth of a micrometre make, metres.
    fn differences_m(task: Task, n_episodes: u64) -> Vec<[f32; 2]> {
        let layout = Layout::new(task, 2);
        let mut env = Env::new(layout, &WorldConfig::default()).unwrap();
        let (mut by_swapping, mut by_nudging) = (Vec::new(), Vec::new());
        for episode in 0..n_episodes {
            let mut rng = episode_rng(2, episode, Stream::Reset);
            let settings = WorldSettings { grasped_start_prob: 0.3, ..WorldSettings::default() };
            let [first, second] =
                sample_starts(&mut rng, layout, env.config.object_half_size_m, settings)[..]
            else {
                panic!()
            };
            let mut noise =
                || (0..layout.n_action()).map(|_| uniform(&mut rng, -0.5, 0.5)).collect();
            let noise: Vec<Vec<f32>> = (0..N_STEPS).map(|_| noise()).collect();
            let noise_swapped: Vec<Vec<f32>> = noise.iter().map(|both| swapped(both)).collect();
            let nudge = |start: ArmStart| ArmStart { object: start.object + NUDGE_M, ..start };
            // Nudges of both ends of a bar would cancel each other.
            let nudged = match task.shares_object() {
                true => [nudge(first), second],
                false => [nudge(first), nudge(second)],
            };

            let original = observations(&mut env, &[first, second], &noise);
            let mirrored = observations(&mut env, &[second, first], &noise_swapped);
            let mirrored: Vec<_> = mirrored.iter().map(|both| swapped(both)).collect();
            by_swapping.push(difference_m(layout, &original, &mirrored));
            by_nudging.push(difference_m(
                layout,
                &original,
                &observations(&mut env, &nudged, &noise),
            ));
        }
        (0..N_STEPS)
            .map(|step| [percentile_90_m(&by_swapping, step), percentile_90_m(&by_nudging, step)])
            .collect()
    }

    /// Contacts amplify rounding errors, so the symmetry is exact only before the first contact. After it, swapping
    /// changes a trajectory about as much as a displacement of the objects by 0.1 µm does. A control step of the shared
    /// world has four times as many physics steps, so that a grasped object amplifies errors to a tenth of a millimetre
    /// within the first one. Its hands tilt, and rounding decides which corners of a tilted pad and a cube touch first, which
    /// nudges do not change: it moves a cube by hundredths of a millimetre. The solver takes the contacts of a bar with both hands and both tables in an order, so swapping
    /// changes its way by up to a millimetre.
    #[test]
    fn swapping_the_arms_is_a_symmetry() {
        for (task, n_episodes, most, corners_m, first_m) in [
            (Task::Push, 120, 1.5, 0.0, 5e-6),
            (Task::PickAndPlace, 240, 1.5, 0.0, 5e-6),
            (Task::SharedPush, 30, 3.0, 5e-5, 5e-6),
            (Task::SharedPickAndPlace, 30, 3.0, 5e-5, 5e-4),
            (Task::CarryBar, 16, 10.0, 0.0, 5e-4),
        ] {
            let differences_m = differences_m(task, n_episodes);
            for (step, [swapping, nudging]) in differences_m.iter().enumerate() {
                assert!(
                    *swapping <= most * nudging + corners_m,
                    "{task}, step {step}: {swapping} m by swapping, {nudging} m by nudging"
                );
            }
            let swapping = differences_m[0][0];
            assert!(swapping < first_m, "{task}: {swapping} m after one step");
        }
    }

    /// Trajectories from reflected starts, under reflected actions, are the reflected trajectories: exactly before the
    /// first contact. The solver takes the contacts of a cube's corners in an order, so later they differ by
    /// millimetres.
    #[test]
    fn one_arm_in_the_shared_world_has_a_mirror_image() {
        for (task, most_m) in [(Task::SharedPush, 0.01), (Task::SharedPickAndPlace, 0.02)] {
            let layout = Layout::new(task, 1);
            let mut env = Env::new(layout, &WorldConfig::default()).unwrap();
            let differences_m: Vec<Vec<f32>> =
                (0..30).map(|episode| reflection_difference_m(&mut env, episode)).collect();
            assert!(percentile_90_m(&differences_m, 0) < 1e-6, "{task}:");
            for step in 0..N_STEPS {
                let difference_m = percentile_90_m(&differences_m, step);
                assert!(difference_m < most_m, "{task}, step {step}: {difference_m} m");
            }
        }
    }

    /// For each step the difference between a trajectory and the reflection of that from the reflected start, metres.
    fn reflection_difference_m(env: &mut Env, episode: u64) -> Vec<f32> {
        let layout = env.layout;
        let spec = TaskSpec::from(layout);
        let mut rng = episode_rng(2, episode, Stream::Reset);
        let starts = sample_starts(
            &mut rng,
            layout,
            env.config.object_half_size_m,
            WorldSettings::default(),
        );
        let mut noise = || (0..layout.n_action()).map(|_| uniform(&mut rng, -0.5, 0.5)).collect();
        let noise: Vec<Vec<f32>> = (0..N_STEPS).map(|_| noise()).collect();
        let mut reflected_noise = noise.clone();
        for (action, reflected) in noise.iter().zip(&mut reflected_noise) {
            spec.reflect_action(ARM, ARM, action, reflected);
        }
        let mirror = |point: Vector| Vector::new(point.x, -point.y, point.z);
        let reflect = |start: &ArmStart| ArmStart {
            end_effector: mirror(start.end_effector),
            object: mirror(start.object),
            object_yaw_rad: -start.object_yaw_rad,
            ..*start
        };
        let reflected_starts: Vec<ArmStart> = starts.iter().map(reflect).collect();
        let original = observations(env, &starts, &noise);
        let mut reflected = observations(env, &reflected_starts, &reflected_noise);
        for observation in &mut reflected {
            spec.reflect_observation(ARM, ARM, &observation.clone(), observation);
        }
        difference_m(layout, &original, &reflected)
    }
}
