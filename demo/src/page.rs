//! What the page shows and changes, as JSON.

use serde_json::{Value, json};
use tandem_core::layout::GOAL_TOLERANCE_M;
use tandem_core::scene::{Point, Scene};
use tandem_core::text::error_chain;
use tandem_core::{ArmIndex, EpisodeKind};
use tandem_picture::{View, between};
use tandem_policy::Policy;

use crate::digest::digest;
use crate::drawing::drawing;
use crate::error::Error;
use crate::live::Live;
use crate::log::EpisodeLog;
use crate::replay::Replay;

/// The state of the page: a policy that acts, and a recorded episode.
#[derive(Default)]
pub struct Page {
    live: Option<(Policy, Live)>,
    replay: Option<Replay>,
}

/// The size of a picture, pixels.
#[derive(Debug, Clone, Copy)]
pub struct Size {
    /// Width.
    pub width: usize,
    /// Height.
    pub height: usize,
}

impl Page {
    /// Loads the policy file in `bytes`, starts its world in state `start` and describes it.
    ///
    /// # Errors
    /// If the file is not a valid policy of a built-in task.
    pub fn load_policy(&mut self, bytes: &[u8], start: u64) -> Result<Value, Error> {
        let policy = Policy::from_bytes(bytes).map_err(|error| Error::Policy(error.into()))?;
        let live = Live::new(&policy, start)?;
        let layout = live.layout();
        let description = json!({
            "task": layout.task.name(), "arms": layout.n_arms, "grasps": layout.task.grasps(),
            "control_step_s": f64::from(layout.task.world().control_step_s()),
            "heights_m": live.goal_heights_m(), "tolerance_m": GOAL_TOLERANCE_M, "digest": policy.digest(),
        });
        self.live = Some((policy, live));
        Ok(description)
    }

    /// Starts the policy's world again, in state `start`.
    ///
    /// # Errors
    /// If no policy is loaded.
    pub fn restart(&mut self, start: u64) -> Result<Value, Error> {
        let (_, live) = self.live.as_mut().ok_or(Error::NothingLoaded)?;
        live.restart(start);
        Ok(status(live))
    }

    /// Executes one action of the policy.
    ///
    /// # Errors
    /// If no policy is loaded, or the physics produces a number that is not finite.
    pub fn step(&mut self) -> Result<Value, Error> {
        let (_, live) = self.live.as_mut().ok_or(Error::NothingLoaded)?;
        live.step()?;
        Ok(status(live))
    }

    /// Moves an arm's goal to `point`, world frame, metres, or to the nearest place where episodes have goals.
    ///
    /// # Errors
    /// If no policy is loaded.
    pub fn move_goal(&mut self, arm: ArmIndex, point: Point) -> Result<Value, Error> {
        let (_, live) = self.live.as_mut().ok_or(Error::NothingLoaded)?;
        if live.layout().arms().any(|it| it == arm) && point.iter().all(|x| x.is_finite()) {
            live.move_goal(arm, point);
        }
        Ok(status(live))
    }

    /// Moves an arm's goal, at its height, to this place of a picture, pixels from the upper left corner.
    ///
    /// # Errors
    /// If no policy is loaded.
    pub fn drag_goal(
        &mut self,
        arm: ArmIndex,
        place: [f64; 2],
        size: Size,
    ) -> Result<Value, Error> {
        let (_, live) = self.live.as_ref().ok_or(Error::NothingLoaded)?;
        let scene = live.scene();
        let goal = scene.goals.get(arm.0).copied();
        let view = View::of(&scene, size.width, size.height);
        match goal.and_then(|goal| view.at_height(place, goal[2])) {
            Some(point) => self.move_goal(arm, point),
            None => Ok(status(live)),
        }
    }

    /// Reads the MCAP log in `bytes`, simulates its episode again and describes the comparison.
    ///
    /// # Errors
    /// If the file is not the complete log of an episode of a built-in task.
    pub fn open_log(&mut self, bytes: &[u8]) -> Result<Value, Error> {
        self.replay = None;
        let replay = Replay::of(EpisodeLog::read(bytes)?)?;
        let log = &replay.log;
        let difference = replay.difference.as_ref().map(|it| {
            json!({
                "step": it.step, "field": it.field, "component": it.component,
                "logged": it.logged.to_string(), "played": it.played.to_string(),
            })
        });
        let description = json!({
            "task": log.layout.task.name(), "arms": log.layout.n_arms, "run": log.run,
            "episode": log.episode.to_string(), "seed": log.seed.to_string(),
            "is_training": log.kind == EpisodeKind::Training, "steps": log.transitions.len(),
            "equal_steps": replay.n_equal_steps(), "difference": difference,
            "is_cut_short": log.last_observation.is_none(),
            "control_step_s": f64::from(log.layout.task.world().control_step_s()),
            "distances_m": replay.frames.iter().map(|frame| &frame.distances_m).collect::<Vec<_>>(),
        });
        self.replay = Some(replay);
        Ok(description)
    }

    /// Returns the [`drawing`] of the policy's world, or of the recorded episode `position` control steps after its
    /// start.
    ///
    /// # Errors
    /// If nothing is loaded.
    pub fn draw(&self, position: Option<f64>, size: Size) -> Result<Value, Error> {
        let scene = self.scene(position)?;
        let achieved: Vec<bool> = match position {
            None => self.live.iter().flat_map(|(_, live)| live.achieved()).collect(),
            Some(position) => self.achieved_at(position),
        };
        Ok(drawing(&scene, &achieved, size.width, size.height))
    }

    /// Returns the [`digest`] of 1,000 steps of the loaded policy.
    ///
    /// # Errors
    /// As [`digest`], and if no policy is loaded.
    pub fn digest(&self) -> Result<Value, Error> {
        let (policy, _) = self.live.as_ref().ok_or(Error::NothingLoaded)?;
        Ok(json!({ "task": policy.task.name(), "digest": digest(policy)? }))
    }

    fn scene(&self, position: Option<f64>) -> Result<Scene, Error> {
        let Some(position) = position else {
            let (_, live) = self.live.as_ref().ok_or(Error::NothingLoaded)?;
            return Ok(live.scene());
        };
        let frames = &self.replay.as_ref().ok_or(Error::NothingLoaded)?.frames;
        let (idx, share) = split(position);
        let before = frames.get(idx).or(frames.last()).ok_or(Error::NothingLoaded)?;
        let after = frames.get(idx + 1).unwrap_or(before);
        Ok(between(&before.scene, &after.scene, share))
    }

    fn achieved_at(&self, position: f64) -> Vec<bool> {
        let frames = self.replay.iter().flat_map(|replay| &replay.frames);
        let frame = frames.take(split(position).0 + 1).last();
        let distances_m = frame.iter().flat_map(|frame| &frame.distances_m);
        distances_m.map(|distance_m| *distance_m <= GOAL_TOLERANCE_M).collect()
    }
}

/// Returns an error on one line.
#[must_use]
pub fn problem(error: &Error) -> String {
    error_chain(error)
}

fn status(live: &Live) -> Value {
    json!({
        "distances_m": live.distances_m().collect::<Vec<_>>(),
        "achieved": live.achieved().collect::<Vec<_>>(),
        "is_success": live.is_success(),
        "is_in_reach": live.is_in_reach(),
        "steps_since_change": live.n_steps_since_change(),
        "steps_to_success": live.n_steps_to_success(),
        "goals": live.scene().goals,
    })
}

/// Splits a position into a step and a share of the way to the next one.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "a float is converted to the nearest number in range"
)]
fn split(position: f64) -> (usize, f32) {
    (position.floor() as usize, (position - position.floor()) as f32)
}
