//! Films of episodes, which `--film` writes, and film strips for reports.

use std::path::Path;

use tandem_core::rng::{Stream, episode_rng};
use tandem_core::{Episode, Layout, TaskSpec, WorldSettings};
use tandem_picture::{Film, FilmEpisode, FilmStep, film_gif_with, film_strip};
use tandem_report::FilmStrip;
use tandem_sim::{Env, SimError, WorldConfig};
use tandem_system::atomic_file;

use crate::cli::FilmArgs;
use crate::exit::{Exit, Failed, OrExit as _};
use crate::{output, run_display};

/// Width and height of a picture in an animation, pixels.
const ANIMATION_SIZE: (usize, usize) = (640, 400);
/// Width and height of a picture in a film strip, pixels.
const STRIP_SIZE: (usize, usize) = (480, 300);

/// A film that the command line asks for.
#[derive(Debug, Clone, Copy)]
pub(crate) struct PlannedFilm<'a> {
    path: &'a Path,
    kind: Kind,
    film: Film,
}

/// The kinds of film, by the ending of their file names.
#[derive(Debug, Clone, Copy)]
enum Kind {
    Animation,
    Strip,
}

impl<'a> PlannedFilm<'a> {
    /// Checks the options of a film. Returns `None` if there is none.
    pub(crate) fn of(args: &'a FilmArgs) -> Result<Option<Self>, Failed> {
        let Some(path) = &args.film else { return Ok(None) };
        output::check_directory_of(path)?;
        let ending = path.extension().unwrap_or_default().to_ascii_lowercase();
        let (kind, default_size) = match ending.to_str() {
            Some("gif") => (Kind::Animation, ANIMATION_SIZE),
            Some("png") => (Kind::Strip, STRIP_SIZE),
            _ => {
                return Err(Failed::usage(format!(
                    "--film {}: the name must end in .gif (an animation) or .png (a strip of pictures)",
                    path.display()
                )));
            }
        };
        let (width, height) = args.film_size.map_or(default_size, |size| (size.width, size.height));
        let film = Film { width, height, speed: args.film_speed };
        let film = film.checked().or_exit(Exit::Usage, || "--film".to_owned())?;
        Ok(Some(Self { path, kind, film }))
    }

    /// Draws the film and writes its file.
    pub(crate) fn write(&self, episodes: &[FilmEpisode]) -> Result<(), Failed> {
        let bytes = match self.kind {
            Kind::Animation => self.animation(episodes),
            Kind::Strip => film_strip(episodes, &self.film),
        };
        let bytes = bytes.or_exit(Exit::Bug, String::new)?;
        atomic_file::replace_target(self.path, &bytes)
            .or_cannot_write(|| format!("cannot write {}", self.path.display()))
    }

    /// Draws an animation, which takes some seconds, with a progress bar on a terminal.
    fn animation(&self, episodes: &[FilmEpisode]) -> Result<Vec<u8>, tandem_picture::Error> {
        let bar = run_display::bar("film");
        let drawn = film_gif_with(episodes, &self.film, |n_frames, n_all| {
            bar.set_length(n_all as u64);
            bar.set_position(n_frames as u64);
        });
        bar.finish_and_clear();
        drawn
    }
}

/// The line of a result that names the file.
impl std::fmt::Display for PlannedFilm<'_> {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(formatter, "film          {}", self.path.display())
    }
}

/// Draws the film strips of episodes as a PNG.
pub(crate) fn strip(episodes: &[FilmEpisode]) -> Result<Vec<u8>, Failed> {
    let (width, height) = STRIP_SIZE;
    film_strip(episodes, &Film { width, height, speed: 1.0 }).or_exit(Exit::Bug, String::new)
}

/// Outcomes of episodes that reports show: the name, and whether it is a success.
pub(crate) const OUTCOMES: [(&str, bool); 2] = [("success", true), ("failure", false)];

/// Adds to `kept` the first episode of each outcome that it lacks.
pub(crate) fn keep_firsts(kept: &mut Vec<Episode>, episodes: &[Episode]) {
    for (_, is_success) in OUTCOMES {
        let has_outcome = |episode: &&Episode| episode.succeeded() == is_success;
        if !kept.iter().any(|episode| has_outcome(&episode)) {
            kept.extend(episodes.iter().find(has_outcome).cloned());
        }
    }
}

/// Draws the first episode with this outcome in an evaluation with `seed`, if there is one.
pub(crate) fn of_outcome(
    layout: Layout,
    seed: u64,
    episodes: &[Episode],
    (outcome, is_success): (&str, bool),
) -> Result<Option<FilmStrip>, Failed> {
    let first = episodes.iter().find(|episode| episode.succeeded() == is_success);
    let Some(first) = first else { return Ok(None) };
    let png = strip(std::slice::from_ref(&of_evaluation(layout, seed, first)?))?;
    let title = format!("A {outcome}: test goal {}", first.number);
    let file_name = format!("film-{outcome}.png");
    Ok(Some(FilmStrip { title, file_name, png, picture_px: STRIP_SIZE }))
}

/// Simulates an episode of an evaluation with `seed` again, for a film.
pub(crate) fn of_evaluation(
    layout: Layout,
    seed: u64,
    episode: &Episode,
) -> Result<FilmEpisode, Failed> {
    let mut world = Env::new(layout, &WorldConfig::default()).or_exit(Exit::Bug, String::new)?;
    world.reset(&mut episode_rng(seed, episode.number, Stream::Reset), WorldSettings::default());
    let actions = (0..episode.n_steps()).map(|step_idx| episode.action(step_idx));
    of_actions(world, actions, episode.number).or_exit(Exit::Bug, String::new)
}

/// Executes `actions` in `world`, which is at the start of episode `number`.
pub(crate) fn of_actions<'a>(
    mut world: Env,
    actions: impl Iterator<Item = &'a [f32]>,
    number: u64,
) -> Result<FilmEpisode, SimError> {
    let task = TaskSpec::from(world.layout());
    let mut n_succeeding = vec![0; task.n_arms()];
    let mut steps = vec![moment(&world, &task, &mut n_succeeding)];
    for action in actions {
        world.step(action)?;
        steps.push(moment(&world, &task, &mut n_succeeding));
    }
    Ok(FilmEpisode { title: format!("{}, episode {number}", task.name()), steps })
}

/// Returns a moment, and counts in `n_succeeding` the consecutive moments in which each arm succeeds. A goal is achieved
/// once its arm has succeeded in as many moments as the task requires.
fn moment(world: &Env, task: &TaskSpec, n_succeeding: &mut [usize]) -> FilmStep {
    let mut observation = vec![0.0; task.n_observation()];
    world.observe(&mut observation);
    let mut achieved = Vec::with_capacity(n_succeeding.len());
    for (arm, n_succeeding) in task.arms().zip(n_succeeding) {
        let succeeds = task.arm_succeeds(arm, &observation, world.goal());
        achieved.push(has_held(n_succeeding, succeeds, task.success_steps()));
    }
    FilmStep { achieved, scene: world.scene() }
}

/// Counts a moment in which an arm succeeds or not. Returns true if it has succeeded in the latest `n_required` ones.
const fn has_held(n_succeeding: &mut usize, succeeds: bool, n_required: usize) -> bool {
    *n_succeeding = if succeeds { *n_succeeding + 1 } else { 0 };
    *n_succeeding >= n_required
}

#[cfg(test)]
mod tests {
    use tandem_core::Task;

    use super::*;

    #[test]
    fn the_first_episode_of_each_outcome_is_kept() {
        let episode = |number: u64, is_success: bool| {
            let mut episode = Episode::zeros(Layout::new(Task::Push, 1), number);
            episode.goal.fill(if is_success { 0.0 } else { 1.0 });
            episode
        };
        let mut kept = Vec::new();
        keep_firsts(&mut kept, &[episode(0, false), episode(1, false)]);
        keep_firsts(&mut kept, &[episode(2, false), episode(3, true), episode(4, true)]);
        keep_firsts(&mut kept, &[episode(5, true), episode(6, false)]);
        assert_eq!(kept.iter().map(|episode| episode.number).collect::<Vec<_>>(), [0, 3]);
    }

    #[test]
    fn a_goal_is_achieved_once_it_has_held_for_the_steps_that_count() {
        let mut n_succeeding = 0;
        let steps = [true, true, false, true, true, true, true, false];
        let held = steps.map(|succeeds| has_held(&mut n_succeeding, succeeds, 3));
        assert_eq!(held, [false, false, false, false, false, true, true, false]);
        assert!(has_held(&mut 0, true, 1));
    }
}
