//! What a policy reached on goals that nobody chose it by: a run's `summary.json`, or a line of `tandem eval --json`.

use std::path::Path;

use serde_json::Value;
use tandem_core::Task;

use crate::error::Error;
use crate::run::read_text;

/// An evaluation on held-out goals.
#[derive(Debug, Clone, PartialEq)]
pub struct HeldOut {
    /// What the arms did.
    pub task: Task,
    /// How many arms did it.
    pub n_arms: usize,
    /// Episodes played.
    pub n_episodes: u64,
    /// Share with every object at its goal, in [0, 1].
    pub success: f64,
    /// Lower and upper end of its 95 % interval.
    pub interval: (f64, f64),
    /// Share with the joint norm within the tolerance.
    pub success_joint: f64,
    /// Share with at least one arm–arm or arm–table contact.
    pub collision_rate: f64,
}

impl HeldOut {
    /// Reads the object on the last line of `path`.
    ///
    /// # Errors
    /// When the file cannot be read or its last line is no such object; names the field.
    pub fn load(path: &Path) -> Result<Self, Error> {
        let text = read_text(path).map_err(|source| Error::Io {
            action: "read",
            path: path.to_owned(),
            source,
        })?;
        Self::parse(&text).map_err(|problem| Error::NoEvaluation { path: path.to_owned(), problem })
    }

    /// Reads the object on the last line of `text`, or says what is wrong with it.
    fn parse(text: &str) -> Result<Self, String> {
        let line = text.lines().rfind(|line| !line.trim().is_empty()).unwrap_or_default();
        let object: Value = serde_json::from_str(line)
            .map_err(|error| format!("the last line is no JSON object ({error})"))?;
        let number =
            |key: &str| object[key].as_f64().ok_or_else(|| format!("{key:?} is no number"));
        let count = |key: &str| object[key].as_u64().ok_or_else(|| format!("{key:?} is no count"));
        let task = object["task"].as_str().unwrap_or_default();
        Ok(Self {
            task: task.parse::<Task>().map_err(|error| error.to_string())?,
            n_arms: usize::try_from(count("arms")?).map_err(|error| error.to_string())?,
            n_episodes: count("episodes")?,
            success: number("success")?,
            interval: (number("success_low")?, number("success_high")?),
            success_joint: number("success_joint")?,
            collision_rate: number("collision_rate")?,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LINE: &str = r#"{"task":"push","arms":2,"episodes":240,"success":0.958,"success_low":0.925,"success_high":0.977,
        "success_joint":0.9,"collision_rate":0.175}"#;

    #[test]
    fn the_last_line_counts() {
        let held_out = HeldOut::parse(&format!("chatter\n{}\n", LINE.replace('\n', ""))).unwrap();
        assert_eq!((held_out.task, held_out.n_arms, held_out.n_episodes), (Task::Push, 2, 240));
        assert_eq!((held_out.success, held_out.interval), (0.958, (0.925, 0.977)));
        assert_eq!((held_out.success_joint, held_out.collision_rate), (0.9, 0.175));
    }

    #[test]
    fn what_is_missing_is_named() {
        let check = |text: &str, word: &str| {
            let problem = HeldOut::parse(text).unwrap_err();
            assert!(problem.contains(word), "{problem:?} lacks {word:?}");
        };
        check("", "JSON");
        check("{}", "task");
        check(&LINE.replace("success_low", "low").replace('\n', ""), "success_low");
    }
}
