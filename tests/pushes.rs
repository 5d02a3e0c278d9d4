//! The shipped push teacher moves its cube from the side and does not drag it from above or tip it.

use std::num::NonZeroUsize;
use std::path::Path;

use tandem_core::layout::EPISODE_STEPS;
use tandem_core::reward::distance;
use tandem_core::{Episode, EpisodeOutcome, EvaluationSummary};
use tandem_policy::Policy;
use tandem_sim::WorldConfig;
use tandem_worker::evaluate;

const N_EPISODES: u64 = 240;
/// Seed of goals that were not used to select the policy.
const SEED: u64 = 4242;
/// Half the cube's edge, metres.
const HALF_M: f32 = 0.0225;
/// Displacement in one step from which a cube counts as moving, metres.
const MOVES_M: f32 = 0.002;
/// Cosine of the tilt from which a cube counts as tipping: 45 degrees.
const TIPPED_COSINE: f32 = 0.707;

fn episodes(name: &str) -> Vec<Episode> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("policies").join(name);
    let policy = Policy::load(&path).expect("ships");
    let actor = policy.actor().expect("whole");
    let n_threads = std::thread::available_parallelism().unwrap_or(NonZeroUsize::MIN);
    let layout = policy.layout.as_built_in().expect("a built-in task");
    evaluate(&actor, layout, &WorldConfig::default(), N_EPISODES, SEED, n_threads).expect("finite")
}

/// Counts the steps in which the object moves, and those among them in which the hand is above it.
fn moving_steps(episode: &Episode) -> (usize, usize) {
    let position = |step_idx: usize| &episode.observation(step_idx)[3..6];
    let moving =
        (0..EPISODE_STEPS).filter(|step| distance(position(*step), position(step + 1)) > MOVES_M);
    moving.fold((0, 0), |(n_moving, n_above), step| {
        let offset = &episode.observation(step)[6..9];
        let is_above =
            offset[0].abs() < HALF_M && offset[1].abs() < HALF_M && -offset[2] > 0.5 * HALF_M;
        (n_moving + 1, n_above + usize::from(is_above))
    })
}

/// Returns true if the object's vertical axis is ever more than 45 degrees off every axis on which it could rest.
fn tips(episode: &Episode) -> bool {
    (0..=EPISODE_STEPS).any(|step| {
        let [x, y, z, w]: [f32; 4] =
            episode.observation(step)[12..16].try_into().expect("a quaternion");
        let up = [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)];
        up.iter().all(|component| component.abs() < TIPPED_COSINE)
    })
}

#[test]
fn the_shipped_push_teacher_pushes() {
    let episodes = episodes("teacher-push.safetensors");
    let outcomes: Vec<EpisodeOutcome> = episodes.iter().map(EpisodeOutcome::of).collect();
    let success = EvaluationSummary::of(&outcomes).success;
    let (n_moving, n_above) =
        episodes.iter().map(moving_steps).fold((0, 0), |a, b| (a.0 + b.0, a.1 + b.1));
    let share_above = n_above as f64 / n_moving as f64;
    let n_tipping = episodes.iter().filter(|episode| tips(episode)).count();
    println!(
        "success {success:.3}, above the cube in {share_above:.3} of {n_moving} moving steps, tipping in {n_tipping}"
    );
    assert!(success >= 0.95, "success {success}");
    assert!(n_moving > 1000, "the object hardly moves");
    assert!(
        share_above < 0.05,
        "the hand is above the cube in {share_above:.2} of the steps in which it moves"
    );
    assert!(
        n_tipping * 10 < episodes.len(),
        "the cube tips in {n_tipping} of {} episodes",
        episodes.len()
    );
}
