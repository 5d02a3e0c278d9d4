//! The start and goals of a trial, and the policy's episode in the training world.

use glam::DVec3;
use tandem_core::{ArmIndex, Contacts, Layout, Stream, TaskSpec, WorldSettings, episode_rng};
use tandem_sim::{Env, SimError, WorldConfig};

use crate::simulated::{Block, SharedObject};
use crate::trial::robustness::Variants;
use crate::trial::shared_object::shared_object;
use crate::trial::training_hand::TrainingHand;
use crate::trial::{ActionSource, TrialError};

/// The smallest gap between two blocks at the start, and between two blocks at their goals, metres.
const ROOM_M: f64 = 0.02;
/// The largest number of starts that are drawn until one has room for the blocks.
const N_DRAWS: usize = 1000;

/// The start and goals of a trial; arm frames, metres.
#[derive(Debug, Clone, PartialEq)]
pub struct TrialStart {
    /// The number of the trial.
    pub number: u64,
    /// The end effectors, arm by arm.
    pub hands: Vec<DVec3>,
    /// The opening of each side of the grippers, metres.
    pub opening_m: f64,
    /// The objects, arm by arm. Heights are those of the training world's blocks.
    pub objects: Vec<DVec3>,
    /// The rotations of the objects about the vertical axis, arm by arm, radians.
    pub yaws_rad: Vec<f64>,
    /// The goals, arm by arm, with the same heights.
    pub goals: Vec<DVec3>,
    /// The object that all arms share, in the training world, if there is one. `objects` are then the arms' points of
    /// it.
    pub shared: Option<SharedObject>,
}

/// Index of the first finger's opening in an arm's observation.
const FIRST_OPENING: usize = 9;

/// One step of a rollout, arm by arm.
#[derive(Debug, Clone, PartialEq)]
pub struct RolloutStep {
    /// The end effectors after the step, arm frames, metres.
    pub hands: Vec<DVec3>,
    /// The openings of the grippers before the step, of each side, metres. A gripper that holds an object is open as
    /// wide as that.
    pub openings_m: Vec<f64>,
    /// The actions of all arms, shape `[n_action]`.
    pub action: Vec<f32>,
}

/// A policy's episode in the training world.
#[derive(Debug, Clone, PartialEq)]
pub struct Rollout {
    /// The steps, in order.
    pub steps: Vec<RolloutStep>,
    /// The distance of each object from its goal after the last step, metres.
    pub goal_distances_m: Vec<f64>,
    /// All contacts of the episode.
    pub contacts: Contacts,
}

/// The training world with blocks of the trial's size, or with its shared object.
pub struct Rehearsal {
    env: Env,
    config: WorldConfig,
    variants: Option<Variants>,
    layout: Layout,
    /// The number of control steps of an episode.
    n_steps: usize,
    half_m: f64,
    /// Half the edge of the blocks whose heights positions have, metres.
    trained_half_m: f64,
}

impl Rehearsal {
    /// Creates the world of `layout` with blocks of the size and mass of `block`. An object that all arms share keeps
    /// its own. Heights of objects and goals are those of blocks with half an edge of `trained_half_m` metres.
    ///
    /// # Errors
    /// Returns an error if there is no such world.
    pub fn new(layout: Layout, block: &Block, trained_half_m: f64) -> Result<Self, SimError> {
        let world = WorldConfig {
            object_half_size_m: block.half_m,
            object_mass_kg: block.mass_kg,
            ..WorldConfig::default()
        };
        let mut rehearsal = Self {
            env: Env::new(layout, &world)?,
            config: world,
            variants: None,
            layout,
            n_steps: TaskSpec::from(layout).episode_steps(),
            half_m: f64::from(block.half_m),
            trained_half_m,
        };
        if let Some(shared) = rehearsal.shared_object() {
            rehearsal.half_m = f64::from(shared.grasped_half_m());
        }
        Ok(rehearsal)
    }

    /// Returns the training world's hand.
    #[must_use]
    pub fn hand(&self) -> TrainingHand {
        TrainingHand::new(&self.env.description())
    }

    /// Returns the object that all arms share, in its current position, or `None` if each arm has its own.
    #[must_use]
    pub fn shared_object(&self) -> Option<SharedObject> {
        TaskSpec::from(self.layout)
            .shares_object()
            .then(|| shared_object(&self.env.description(), &self.env.scene().objects))
    }

    /// Draws the start of trial `number` of `seed` as the training world does, with room between blocks and such that
    /// `is_free` accepts it. A shared object lies where the training world puts it.
    ///
    /// # Errors
    /// Returns an error if no start has room for the blocks.
    pub fn start(
        &mut self,
        seed: u64,
        number: u64,
        is_free: impl Fn(&TrialStart) -> bool,
    ) -> Result<TrialStart, TrialError> {
        let mut rng = episode_rng(seed, number, Stream::Reset);
        for _ in 0..N_DRAWS {
            let before = rng.clone();
            self.env.reset(&mut rng, WorldSettings::default());
            let start = self.current_start(number);
            if self.has_room(&start) && is_free(&start) {
                if let Some(variants) = &mut self.variants {
                    variants.reset(&before);
                }
                return Ok(start);
            }
        }
        Err(TrialError::NoRoom { half_m: self.half_m })
    }

    /// Plays the policy's episode from the start that was drawn last.
    ///
    /// # Errors
    /// Returns an error if the simulation fails.
    pub fn play(&self, policy: &mut dyn ActionSource) -> Result<Rollout, SimError> {
        let mut env = self.env.clone();
        let mut observation = vec![0.0; self.layout.n_observation()];
        let goal = env.goal().to_vec();
        let mut contacts = Contacts::NONE;
        let mut steps = Vec::with_capacity(self.n_steps);
        for _ in 0..self.n_steps {
            env.observe(&mut observation);
            let mut action = vec![0.0; self.layout.n_action()];
            policy.act(&observation, &goal, &mut action);
            let openings_m = self.openings_m(&observation);
            contacts = contacts | env.step(&action)?;
            env.observe(&mut observation);
            let hands = self.points(&observation, 0);
            steps.push(RolloutStep { hands, openings_m, action });
        }
        let goal_distances_m = goal_distances_m(&env, &observation);
        Ok(Rollout { steps, goal_distances_m, contacts })
    }

    /// Prepares variants of the world for the starts that are drawn from now on. An object that all arms share has
    /// none: they do not predict how an object that two hands hold behaves.
    pub(super) fn add_variants(&mut self) -> Result<(), SimError> {
        if !TaskSpec::from(self.layout).shares_object() {
            let action_m = self.env.description().hand.action_m;
            self.variants = Some(Variants::new(self.layout, &self.config, action_m)?);
        }
        Ok(())
    }

    /// Returns the variants of the world, at the start that was drawn last.
    pub(super) fn variants(&self) -> Option<&Variants> {
        self.variants.as_ref()
    }

    fn current_start(&self, number: u64) -> TrialStart {
        let mut observation = vec![0.0; self.layout.n_observation()];
        self.env.observe(&mut observation);
        let grasps = self.layout.task.grasps();
        let opening_m = if grasps { self.hand().max_opening_m() } else { 0.0 };
        let (hands, objects) = (self.points(&observation, 0), self.points(&observation, 3));
        TrialStart {
            number,
            hands,
            opening_m,
            objects: self.above_rest(objects),
            yaws_rad: self.yaws_rad(&observation),
            goals: self.goals(),
            shared: self.shared_object(),
        }
    }

    /// The openings of the grippers, metres.
    fn openings_m(&self, observation: &[f32]) -> Vec<f64> {
        let of_arm = |arm: ArmIndex| &observation[self.layout.observation_of(arm)];
        self.layout.arms().map(|arm| f64::from(of_arm(arm)[FIRST_OPENING])).collect()
    }

    /// The point at index `first` of each arm's observation.
    fn points(&self, observation: &[f32], first: usize) -> Vec<DVec3> {
        let of_arm = |arm: ArmIndex| &observation[self.layout.observation_of(arm)][first..];
        self.layout.arms().map(|arm| point(of_arm(arm))).collect()
    }

    /// Returns the rotations of the objects about the vertical axis, radians.
    fn yaws_rad(&self, observation: &[f32]) -> Vec<f64> {
        let of_arm = |arm| yaw_rad(&observation[self.layout.observation_of(arm)]);
        self.layout.arms().map(of_arm).collect()
    }

    fn goals(&self) -> Vec<DVec3> {
        let goal = self.env.goal();
        let goals = self.layout.arms().map(|arm| point(&goal[self.layout.goal_of(arm)])).collect();
        self.above_rest(goals)
    }

    /// Lowers positions of objects to the heights of the blocks that the policy knows.
    fn above_rest(&self, places: Vec<DVec3>) -> Vec<DVec3> {
        let lower = DVec3::Z * (self.half_m - self.trained_half_m);
        places.into_iter().map(|place| place - lower).collect()
    }

    /// Returns whether the blocks have room between each other at the start and at the goals, in any orientation.
    fn has_room(&self, start: &TrialStart) -> bool {
        if TaskSpec::from(self.layout).shares_object() {
            return true;
        }
        let scene = self.env.scene();
        let apart_m = 2.0 * self.half_m * std::f64::consts::SQRT_2 + ROOM_M;
        let places = [
            scene.objects.iter().map(|object| object.centre).collect::<Vec<_>>(),
            scene.goals.clone(),
        ];
        let hands: Vec<_> = scene.arms.iter().map(|arm| arm.end_effector).collect();
        let hand_m = self.half_m * std::f64::consts::SQRT_2 + 0.05;
        start.hands.len() == 1
            || places.iter().all(|places| pairs_apart(places, apart_m))
                && hands.iter().all(|hand| {
                    places[0].iter().all(|object| horizontal_m(*hand, *object) >= hand_m)
                })
    }
}

/// Returns the distance of each arm's object, in `observation` of `env`, from its goal, metres.
pub(super) fn goal_distances_m(env: &Env, observation: &[f32]) -> Vec<f64> {
    let layout = env.layout();
    let distance = |arm: ArmIndex| {
        let object = point(&observation[layout.observation_of(arm)][3..]);
        (object - point(&env.goal()[layout.goal_of(arm)])).length()
    };
    layout.arms().map(distance).collect()
}

fn point(numbers: &[f32]) -> DVec3 {
    DVec3::new(numbers[0].into(), numbers[1].into(), numbers[2].into())
}

/// Returns the rotation of the object about the vertical axis in the observation of one arm, radians.
fn yaw_rad(observation: &[f32]) -> f64 {
    let [z, w] = [14, 15].map(|idx| f64::from(observation[idx]));
    2.0 * libm::atan2(z, w)
}

fn horizontal_m(a: [f32; 3], b: [f32; 3]) -> f64 {
    f64::from((a[0] - b[0]).hypot(a[1] - b[1]))
}

fn pairs_apart(places: &[[f32; 3]], apart_m: f64) -> bool {
    let far = |(idx, place): (usize, &[f32; 3])| {
        places[..idx].iter().all(|other| horizontal_m(*place, *other) >= apart_m)
    };
    places.iter().enumerate().all(far)
}
