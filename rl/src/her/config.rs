//! Section `[replay]` of the run file.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use tandem_core::TaskSpec;
use tandem_core::settings::OutOfRange;

/// The reward that the critic learns.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize, JsonSchema, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum RewardKind {
    /// One reward: 0 if the norm over all arms' goal distances is within the tolerance, else -1.
    Joint,
    /// One reward per arm, and a critic head for each.
    PerArm,
}

impl RewardKind {
    /// Returns the number of the critic's heads.
    #[must_use]
    pub fn n_heads(self, task: &TaskSpec) -> usize {
        match self {
            Self::Joint => 1,
            Self::PerArm => task.n_arms(),
        }
    }
}

/// Section `[replay]` of the run file: the replay buffer, and how batches are sampled from it.
#[derive(Debug, Clone, PartialEq, Deserialize, JsonSchema, Serialize)]
#[serde(deny_unknown_fields)]
pub struct ReplayConfig {
    /// Capacity in transitions, at least one episode's steps, 50 in the built-in tasks (baselines HER: 1,000,000).
    pub capacity_transitions: usize,
    /// Fraction of transitions that get a hindsight goal, in [0, 1]: k/(k + 1) for k goals per transition (Andrychowicz
    /// et al. 2017: k = 4).
    pub her_ratio: f32,
    /// Whether only steps after which an object has moved from its start, by more than the task's tolerance, give
    /// hindsight goals. Others are achieved by doing nothing.
    #[serde(default)]
    pub displaced_hindsight: bool,
    /// Fraction of transitions sampled from episodes in which an object was displaced, in [0, 1].
    pub displaced_fraction: f32,
    /// Fraction of two-arm transitions that combine the arms of two steps, in [0, 1]: counterfactual data augmentation
    /// (CoDA, Pitis et al. 2020). A combination in which the arms are near each other is rejected. It takes effect with
    /// `replay.reward = "per-arm"` and tasks whose arms can be recombined only.
    pub coda_fraction: f32,
    /// Probability, in [0, 1], that two steps after which the hands of both arms would overlap are combined into a
    /// transition with a contact. It takes effect where `replay.coda_fraction` does, in tasks that describe at which
    /// distance hands are in contact. No built-in task does: it has to be 0 there.
    #[serde(default)]
    pub coda_contact_prob: f32,
    /// Probability that the arms of a transition exchange places, in [0, 1]: an exact symmetry of worlds whose arms are
    /// interchangeable.
    pub arm_swap_prob: f32,
    /// Probability that a transition is reflected, in [0, 1] (invariant transform experience replay, Lin et al. 2020).
    /// It takes effect in tasks that describe a reflection only, as those of the shared world do, and unless their
    /// whole scene has a mirror image, while arms are far enough apart to be recombined.
    #[serde(default)]
    pub reflection_prob: f32,
    /// The reward that the critic learns.
    pub reward: RewardKind,
    /// Whether the goals in the normaliser's statistics get one hindsight step for all arms, as goals in batches do
    /// with the joint reward, or a step for each arm.
    #[serde(default)]
    pub joint_goal_statistics: bool,
    /// Distance between an object and its goal, in the unit of the goal, within which training rewards it: in the
    /// built-in tasks 0.0001 to 1 m, else above 0 (paper: not given; Fetch environments: 0.05 m). The task's own
    /// tolerance always defines success. A smaller distance leaves room for the motion of an object after its release.
    pub goal_tolerance_m: f32,
    /// Cost to an arm of a step on which it touches another arm or the table, 0 to 100; a pending goal costs 1 (paper:
    /// 0). A contact with the table costs every arm unless the environment says which arm it was, as the shared world
    /// does.
    pub contact_cost: f32,
    /// Factor by which this cost grows, 1 to 100: linearly from a tenth to half of the run's environment steps, so that
    /// the policy first learns to achieve goals (paper: 1). A run without a limit in environment steps keeps the cost.
    #[serde(default = "constant")]
    pub contact_cost_growth: f32,
    /// An arm's advice is not cloned on the last steps before a contact that costs it: this many, counting the step of
    /// the contact, 0 to the episode's steps (paper: 0).
    pub contact_foresight_steps: usize,
}

/// The factor of a cost that stays the same.
const fn constant() -> f32 {
    1.0
}

impl ReplayConfig {
    /// Returns the lowest reward of a step: that of a pending goal and the largest cost of a contact.
    #[must_use]
    pub const fn lowest_reward(&self) -> f32 {
        -1.0 - self.contact_cost * self.contact_cost_growth
    }

    /// Checks every range for a task; NaN is in none.
    ///
    /// # Errors
    /// Names the first setting that is out of its range.
    pub fn check(&self, task: &TaskSpec) -> Result<(), OutOfRange> {
        let fractions = [
            ("replay.her_ratio", self.her_ratio),
            ("replay.displaced_fraction", self.displaced_fraction),
            ("replay.coda_fraction", self.coda_fraction),
            ("replay.coda_contact_prob", self.coda_contact_prob),
            ("replay.arm_swap_prob", self.arm_swap_prob),
            ("replay.reflection_prob", self.reflection_prob),
        ];
        for (key, value) in fractions {
            OutOfRange::check_fraction(key, value)?;
        }
        let (key, tolerance_m) = ("replay.goal_tolerance_m", self.goal_tolerance_m);
        if task.as_built_in().is_some() {
            OutOfRange::check_range(key, tolerance_m, 1e-4..=1.0)?;
        }
        let is_tolerance = tolerance_m.is_finite() && tolerance_m > 0.0;
        OutOfRange::unless(is_tolerance, key, tolerance_m, "a finite number above 0")?;
        OutOfRange::check_range("replay.contact_cost", self.contact_cost, 0.0..=100.0)?;
        let (key, growth) = ("replay.contact_cost_growth", self.contact_cost_growth);
        OutOfRange::check_range(key, growth, 1.0..=100.0)?;
        let (key, n_steps) = ("replay.contact_foresight_steps", self.contact_foresight_steps);
        let n_max = task.episode_steps();
        OutOfRange::unless(n_steps <= n_max, key, n_steps, format_args!("0 to {n_max}"))?;
        let (key, capacity) = ("replay.capacity_transitions", self.capacity_transitions);
        OutOfRange::unless(capacity >= n_max, key, capacity, format_args!("at least {n_max}"))?;
        let symmetry = "0 for this task, whose arms are not interchangeable";
        let (key, prob) = ("replay.arm_swap_prob", self.arm_swap_prob);
        let is_usable = prob == 0.0 || task.n_arms() == 1 || task.has_interchangeable_arms();
        OutOfRange::unless(is_usable, key, prob, symmetry)?;
        let recombination = "0 for this task, whose arms cannot be recombined";
        let (key, fraction) = ("replay.coda_fraction", self.coda_fraction);
        let is_usable = fraction == 0.0 || task.n_arms() != 2 || task.has_recombinable_arms();
        OutOfRange::unless(is_usable, key, fraction, recombination)?;
        let unknown = "0 for this task, which does not describe when hands are in contact";
        let (key, prob) = ("replay.coda_contact_prob", self.coda_contact_prob);
        let is_usable = prob == 0.0 || task.n_arms() != 2 || task.describes_contacts();
        OutOfRange::unless(is_usable, key, prob, unknown)
    }
}
