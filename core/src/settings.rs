//! Settings of a run that its workers need as well: how training episodes explore and start, and how finely the world
//! is simulated.
//!
//! Each struct is declared once: the run file contains it as a section, the learner sends it with the run's terms, and
//! the simulator takes it as it is. Another world setting needs a field here, its conversion in `proto` and its effect
//! in `sim`.

use std::fmt::Display;
use std::ops::RangeInclusive;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::episode::EpisodeKind;

/// Section `[exploration]`: exploration in training episodes.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize, JsonSchema, Serialize)]
#[serde(deny_unknown_fields)]
pub struct Exploration {
    /// Standard deviation of the Gaussian noise added to every action component, 0 to 10.
    pub noise_std: f32,
    /// Probability that an arm's step takes a random action, in [0, 1) (baselines HER: `random_eps`).
    pub random_action_prob: f32,
    /// Mean number of steps for which an arm repeats a random action, 1 to the steps of an episode; 1 draws a
    /// new one each step.
    pub sticky_random_mean_steps: f32,
    /// Whether random actions start on all arms at once, so that the whole action is random (baselines HER), or on each
    /// arm independently.
    #[serde(default)]
    pub joint_random_actions: bool,
}

impl Exploration {
    /// No exploration: the policy's actions are executed unchanged.
    pub const NONE: Self = Self {
        noise_std: 0.0,
        random_action_prob: 0.0,
        sticky_random_mean_steps: 1.0,
        joint_random_actions: false,
    };

    /// Checks every range for a task with episodes of `episode_steps` steps; NaN is in none.
    ///
    /// # Errors
    /// Names the first setting that is out of its range.
    pub fn check(&self, episode_steps: usize) -> Result<(), OutOfRange> {
        let Self { noise_std, random_action_prob, sticky_random_mean_steps, .. } = *self;
        OutOfRange::check_range("exploration.noise_std", noise_std, 0.0..=10.0)?;
        OutOfRange::check_below_one("exploration.random_action_prob", random_action_prob)?;
        let is_mean = (1.0..=episode_steps as f64).contains(&f64::from(sticky_random_mean_steps));
        let key = "exploration.sticky_random_mean_steps";
        let expected = format_args!("1 to {episode_steps}, the steps of an episode").to_string();
        OutOfRange::unless(is_mean, key, sticky_random_mean_steps, expected)
    }
}

/// Terms on which workers ask for advice: two settings of section `[advice]`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct AdviceTerms {
    /// The action of the student that the teacher judges.
    pub judged_action: JudgedAction,
    /// The steps that a unit of the budget pays for.
    pub unit: AdviceUnit,
}

/// The action of the student that the teacher judges.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize, JsonSchema, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum JudgedAction {
    /// The action that the student is about to execute, exploration included.
    #[default]
    Executed,
    /// The policy's action without exploration: π_st(s) of equation 10.
    Policy,
}

/// The steps that a unit of the advice budget pays for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize, JsonSchema, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum AdviceUnit {
    /// One step of one episode.
    #[default]
    EnvStep,
    /// One lock step of a slot: the simultaneous steps of all its advised episodes.
    SlotStep,
}

/// Section `[world]`: starts of training episodes, and the resolution of the simulation. The default is the setting in
/// which policies are evaluated.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize, JsonSchema, Serialize)]
#[serde(deny_unknown_fields)]
pub struct WorldSettings {
    /// Probability that a training episode starts with the objects grasped (pick and place), in [0, 1].
    pub grasped_start_prob: f32,
    /// Environment steps of a run over which this probability falls linearly to 0; 0 keeps it.
    #[serde(default)]
    pub grasped_start_env_steps: u64,
    /// Resolution of the physics: 20, or 10 for quick tests. It is the number of physics steps per control step in the
    /// classic world, and a quarter of it in the other ones. The test at the end of a run, `tandem eval` and films use
    /// 20.
    pub substeps: u32,
    /// Extent to which the world varies between training episodes, in [0, 1]: size and mass of the objects, friction of
    /// objects, table and pads, delay of the actions, noise of the observations and, in the shared world, the gap of up
    /// to 2 cm below which two arms count as touching. 0 disables it, 1 uses the full ranges. Files of earlier versions
    /// have 0.
    #[serde(default)]
    pub randomization: f32,
}

impl Default for WorldSettings {
    fn default() -> Self {
        Self {
            grasped_start_prob: 0.0,
            grasped_start_env_steps: 0,
            substeps: 20,
            randomization: 0.0,
        }
    }
}

/// Keys of the settings in the metadata of episode logs, which other programs read.
const LOGGED_GRASPED_START_PROB: &str = "gripped_start_share";
const LOGGED_SUBSTEPS: &str = "substeps";
const LOGGED_RANDOMIZATION: &str = "randomization";

impl WorldSettings {
    /// Checks every range; NaN is in none.
    ///
    /// # Errors
    /// Names the first setting that is out of its range.
    pub fn check(&self) -> Result<(), OutOfRange> {
        let Self { grasped_start_prob, grasped_start_env_steps: _, substeps, randomization } =
            *self;
        OutOfRange::check_fraction("world.randomization", randomization)?;
        OutOfRange::check_fraction("world.grasped_start_prob", grasped_start_prob)?;
        OutOfRange::unless(matches!(substeps, 10 | 20), "world.substeps", substeps, "10 or 20")
    }

    /// Returns the settings for an episode of `kind`: evaluation episodes start as the task says.
    #[must_use]
    pub fn for_kind(self, kind: EpisodeKind) -> Self {
        match kind {
            EpisodeKind::Training => self,
            EpisodeKind::Evaluation => Self { substeps: self.substeps, ..Self::default() },
        }
    }

    /// Returns the settings for an episode of `kind` whose run has had `env_steps` environment steps before it: a
    /// probability that falls has its value at that time.
    #[must_use]
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_precision_loss,
        reason = "a share, of numbers of steps far below 2^53"
    )]
    pub fn at(self, kind: EpisodeKind, env_steps: u64) -> Self {
        let settings = self.for_kind(kind);
        if settings.grasped_start_env_steps == 0 {
            return settings;
        }
        let past = env_steps as f64 / settings.grasped_start_env_steps as f64;
        let left = (1.0 - past).max(0.0) as f32;
        Self {
            grasped_start_prob: left * settings.grasped_start_prob,
            grasped_start_env_steps: 0,
            ..settings
        }
    }

    /// Returns the settings as entries of an episode log's metadata. A world that does not vary has no entry for that.
    #[must_use]
    pub fn log_entries(self) -> Vec<(&'static str, String)> {
        let mut entries = vec![
            (LOGGED_SUBSTEPS, self.substeps.to_string()),
            (LOGGED_GRASPED_START_PROB, self.grasped_start_prob.to_string()),
        ];
        if self.randomization != 0.0 {
            entries.push((LOGGED_RANDOMIZATION, self.randomization.to_string()));
        }
        entries
    }

    /// Reads the settings from an episode log's metadata; `entry` looks up an entry.
    ///
    /// # Errors
    /// Returns the key of the first entry that is missing or not a number.
    pub fn from_log_entries<'a>(
        entry: impl Fn(&str) -> Option<&'a str>,
    ) -> Result<Self, &'static str> {
        let number = |key| entry(key).and_then(|text| text.parse().ok()).ok_or(key);
        let count = |key| entry(key).and_then(|text| text.parse().ok()).ok_or(key);
        // Earlier versions had none.
        let randomization = entry(LOGGED_RANDOMIZATION).map_or(Some(0.0), |text| text.parse().ok());
        Ok(Self {
            grasped_start_prob: number(LOGGED_GRASPED_START_PROB)?,
            // A log has the probability at the time of its episode.
            grasped_start_env_steps: 0,
            substeps: count(LOGGED_SUBSTEPS)?,
            randomization: randomization.ok_or(LOGGED_RANDOMIZATION)?,
        })
    }
}

/// A setting whose value cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{key} is {value}: expected {expected}")]
pub struct OutOfRange {
    /// Dotted name of the setting.
    pub key: &'static str,
    /// Its value.
    pub value: String,
    /// The values that can be used.
    pub expected: String,
}

impl OutOfRange {
    /// Returns an error about the setting `key` unless `is_usable`.
    ///
    /// # Errors
    /// Returns an error unless `is_usable`.
    pub fn unless(
        is_usable: bool,
        key: &'static str,
        value: impl Display + Copy,
        expected: impl Display,
    ) -> Result<(), Self> {
        match is_usable {
            true => Ok(()),
            false => Err(Self { key, value: value.to_string(), expected: expected.to_string() }),
        }
    }

    /// Checks that the value of the setting `key` is in `range`; NaN is not.
    ///
    /// # Errors
    /// Returns an error that names the range as, for example, `1 to 100,000`.
    pub fn check_range<T: PartialOrd + Display + Copy>(
        key: &'static str,
        value: T,
        range: RangeInclusive<T>,
    ) -> Result<(), Self> {
        if range.contains(&value) {
            return Ok(());
        }
        let [low, high] = [range.start(), range.end()].map(|bound| grouped(&bound.to_string()));
        Self::unless(false, key, value, format_args!("{low} to {high}"))
    }

    /// Checks that the value of the setting `key` is in [0, 1]; NaN is not.
    ///
    /// # Errors
    /// Returns an error about any other value.
    pub fn check_fraction(
        key: &'static str,
        value: impl Into<f64> + Display + Copy,
    ) -> Result<(), Self> {
        let number: f64 = value.into();
        Self::unless((0.0..=1.0).contains(&number), key, value, "a number in [0, 1]")
    }

    /// Checks that the value of the setting `key` is in [0, 1); NaN is not.
    ///
    /// # Errors
    /// Returns an error about any other value.
    pub fn check_below_one(
        key: &'static str,
        value: impl Into<f64> + Display + Copy,
    ) -> Result<(), Self> {
        let number: f64 = value.into();
        Self::unless((0.0..1.0).contains(&number), key, value, "a number in [0, 1)")
    }
}

/// Separates the thousands of a whole number with commas. Any other text is returned unchanged.
fn grouped(number: &str) -> String {
    if !number.bytes().all(|byte| byte.is_ascii_digit()) {
        return number.to_owned();
    }
    let mut grouped = String::new();
    for (idx, digit) in number.chars().enumerate() {
        if idx > 0 && (number.len() - idx).is_multiple_of(3) {
            grouped.push(',');
        }
        grouped.push(digit);
    }
    grouped
}

#[cfg(test)]
mod tests {
    use super::*;

    const WORLD: WorldSettings = WorldSettings {
        grasped_start_prob: 0.3,
        grasped_start_env_steps: 0,
        substeps: 10,
        randomization: 0.25,
    };

    #[test]
    fn the_share_of_grasped_starts_falls_over_training() {
        let falling = WorldSettings { grasped_start_env_steps: 1000, ..WORLD };
        for (env_steps, expected) in [(0, 0.3), (500, 0.15), (1000, 0.0), (5000, 0.0)] {
            let at = falling.at(EpisodeKind::Training, env_steps);
            assert_eq!(at, WorldSettings { grasped_start_prob: expected, ..WORLD }, "{env_steps}");
        }
        assert_eq!(WORLD.at(EpisodeKind::Training, 9000), WORLD);
        assert_eq!(falling.at(EpisodeKind::Evaluation, 0), WORLD.for_kind(EpisodeKind::Evaluation));
    }

    #[test]
    fn only_training_episodes_start_specially() {
        assert_eq!(WORLD.for_kind(EpisodeKind::Training), WORLD);
        let evaluated = WorldSettings { substeps: 10, ..WorldSettings::default() };
        assert_eq!(WORLD.for_kind(EpisodeKind::Evaluation), evaluated);
    }

    #[test]
    fn log_entries_are_read_back_and_a_bad_one_is_named() {
        let entries = WORLD.log_entries();
        let lookup = |key: &str| {
            entries.iter().find(|(name, _)| *name == key).map(|(_, value)| value.as_str())
        };
        assert_eq!(WorldSettings::from_log_entries(lookup), Ok(WORLD));
        let spoilt = |key: &str| if key == "substeps" { Some("ten") } else { lookup(key) };
        assert_eq!(WorldSettings::from_log_entries(spoilt), Err("substeps"));
        let former = |key: &str| if key == "randomization" { None } else { lookup(key) };
        let steady = WorldSettings { randomization: 0.0, ..WORLD };
        assert_eq!(WorldSettings::from_log_entries(former), Ok(steady));
        assert_eq!(steady.log_entries().len(), 2, "former logs are written as before");
    }

    #[test]
    fn values_out_of_range_are_named() {
        let world = WorldSettings { grasped_start_prob: f32::NAN, ..WORLD };
        assert_eq!(world.check().map_err(|error| error.key), Err("world.grasped_start_prob"));
        let world = WorldSettings { randomization: 1.5, ..WORLD };
        assert_eq!(world.check().map_err(|error| error.key), Err("world.randomization"));
        let exploration = Exploration { random_action_prob: 1.0, ..Exploration::NONE };
        let message = exploration.check(50).expect_err("out of range").to_string();
        assert_eq!(message, "exploration.random_action_prob is 1: expected a number in [0, 1)");
        let sticky = Exploration { sticky_random_mean_steps: 80.0, ..Exploration::NONE };
        let message = sticky.check(50).expect_err("longer than an episode").to_string();
        let expected =
            "exploration.sticky_random_mean_steps is 80: expected 1 to 50, the steps of an episode";
        assert_eq!((message.as_str(), sticky.check(100)), (expected, Ok(())));
        assert_eq!((Exploration::NONE.check(1), WORLD.check()), (Ok(()), Ok(())));
    }

    #[test]
    fn a_range_includes_its_bounds_and_is_named_in_the_error() {
        let expected = |checked: Result<(), OutOfRange>| checked.map_err(|error| error.expected);
        for inside in [1, 65_536] {
            assert_eq!(OutOfRange::check_range("key", inside, 1..=65_536), Ok(()));
        }
        for (range, named) in [
            (1..=16, "1 to 16"),
            (0..=999, "0 to 999"),
            (1..=4096, "1 to 4,096"),
            (1..=1_000_000, "1 to 1,000,000"),
        ] {
            let above = range.end() + 1;
            assert_eq!(
                expected(OutOfRange::check_range("key", above, range)),
                Err(named.to_owned())
            );
        }
        let tolerance = OutOfRange::check_range("key", f32::NAN, 1e-4..=1.0);
        assert_eq!(expected(tolerance), Err("0.0001 to 1".to_owned()));
        assert_eq!(OutOfRange::check_fraction("key", 1.0_f32), Ok(()));
        let fraction = OutOfRange::check_fraction("key", f64::NAN);
        assert_eq!(expected(fraction), Err("a number in [0, 1]".to_owned()));
        assert_eq!(OutOfRange::check_below_one("key", 0.0_f32), Ok(()));
        let below_one = OutOfRange::check_below_one("key", 1.0_f32);
        assert_eq!(expected(below_one), Err("a number in [0, 1)".to_owned()));
    }
}
