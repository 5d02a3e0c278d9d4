//! Prints how a policy moves its cubes: whether it pushes, drags, tips or hits them:
//! `cargo run --release --example pushes -- policies/student-push.safetensors`.
#![expect(clippy::print_stdout, reason = "an example that prints its results")]

use std::num::NonZeroUsize;
use std::path::Path;

use rapier3d::geometry::SharedShape;
use rapier3d::math::{Pose, Rotation, Vector};
use rapier3d::parry::query;
use rayon::iter::{IntoParallelRefIterator as _, ParallelIterator as _};
use tandem_core::reward::distance;
use tandem_core::scene::{Cuboid, Scene};
use tandem_core::{ArmIndex, Episode, EpisodeOutcome, EvaluationSummary, Stream};
use tandem_core::{WorldSettings, episode_rng};
use tandem_policy::Policy;
use tandem_sim::{Env, WorldConfig};
use tandem_worker::Evaluation;

type AnyError = Box<dyn std::error::Error + Send + Sync>;

/// Number of episodes.
const N_EPISODES: u64 = 240;
/// Seed of goals that were not used to select the shipped policies.
const SEED: u64 = 4242;
/// Displacement in one step from which a cube counts as moving, metres.
const MOVES_M: f32 = 0.002;
/// Distance from a hand up to which a cube counts as touched, metres.
const TOUCHES_M: f32 = 0.004;
/// Cosine of the tilt from which a cube counts as tipping: 45 degrees.
const TIPPED_COSINE: f32 = 0.707;

/// How the arms of a policy moved their cubes in a number of episodes.
#[derive(Debug, Default)]
pub(crate) struct Pushes {
    /// Share of episodes with every cube at its goal.
    pub(crate) success: f64,
    /// Steps in which a cube moved, over all arms.
    pub(crate) n_moving: usize,
    /// Steps among them in which the arm's hand was above its cube.
    pub(crate) n_above: usize,
    /// Episodes in which a cube tipped by more than 45 degrees.
    pub(crate) n_tipping: usize,
    /// Length of the paths of all cubes, metres.
    pub(crate) path_m: f64,
    /// Length of those steps of the paths after which no hand touched the cube, metres.
    pub(crate) gliding_m: f64,
}

impl Pushes {
    /// Returns the share of moving steps in which the hand was above the cube.
    pub(crate) fn share_above(&self) -> f64 {
        self.n_above as f64 / self.n_moving.max(1) as f64
    }

    /// Returns the share of the cubes' paths on which no hand touched them.
    pub(crate) fn share_gliding(&self) -> f64 {
        if self.path_m > 0.0 { self.gliding_m / self.path_m } else { 0.0 }
    }

    fn plus(self, other: &Self) -> Self {
        Self {
            success: self.success,
            n_moving: self.n_moving + other.n_moving,
            n_above: self.n_above + other.n_above,
            n_tipping: self.n_tipping + other.n_tipping,
            path_m: self.path_m + other.path_m,
            gliding_m: self.gliding_m + other.gliding_m,
        }
    }
}

fn main() -> Result<(), AnyError> {
    let files: Vec<String> = std::env::args().skip(1).collect();
    if files.is_empty() {
        return Err("usage: pushes POLICY.safetensors...".into());
    }
    for file in files {
        let pushes = measure(&Policy::load(Path::new(&file))?, N_EPISODES)?;
        println!(
            "{file}: success {:.3}, hand above the cube {:.3} of moving steps, tipping {:.3} of episodes, gliding \
             {:.3} of the path ({:.1} cm per episode)",
            pushes.success,
            pushes.share_above(),
            pushes.n_tipping as f64 / N_EPISODES as f64,
            pushes.share_gliding(),
            100.0 * pushes.path_m / N_EPISODES as f64
        );
    }
    Ok(())
}

/// Plays `n_episodes` of the policy in its world and measures how it moves its cubes.
pub(crate) fn measure(policy: &Policy, n_episodes: u64) -> Result<Pushes, AnyError> {
    let actor = policy.actor()?;
    let layout = policy.task.as_built_in().ok_or("the policy is not for a built-in task")?;
    let (world, n_threads) = (WorldConfig::default(), std::thread::available_parallelism());
    let n_threads = n_threads.unwrap_or(NonZeroUsize::MIN);
    let numbers = 0..n_episodes;
    let evaluation = Evaluation { layout, world: &world, seed: SEED, numbers, n_threads };
    let episodes = evaluation.run(|_| actor.clone())?;
    let outcomes: Vec<EpisodeOutcome> = episodes.iter().map(EpisodeOutcome::of).collect();
    let env = Env::new(layout, &world)?;
    let parts = episodes.par_iter().map(|episode| measure_episode(env.clone(), episode));
    let parts: Vec<Pushes> = parts.collect::<Result<_, AnyError>>()?;
    let success = EvaluationSummary::of(&outcomes).success;
    Ok(parts.iter().fold(Pushes { success, ..Pushes::default() }, Pushes::plus))
}

/// Simulates the episode again, with all bodies.
fn measure_episode(mut env: Env, episode: &Episode) -> Result<Pushes, AnyError> {
    let mut rng = episode_rng(SEED, episode.number, Stream::Reset);
    env.reset(&mut rng, WorldSettings::default());
    let mut pushes = Pushes::default();
    let mut is_tipping = false;
    let mut before = env.scene();
    for step_idx in 0..episode.n_steps() {
        env.step(episode.action(step_idx))?;
        let after = env.scene();
        for arm in episode.task.arms() {
            let (from, to) = (&before.objects[arm.0], &after.objects[arm.0]);
            let moved_m = distance(&from.centre, &to.centre);
            if moved_m > MOVES_M {
                pushes.n_moving += 1;
                pushes.n_above += usize::from(is_above(&before, arm));
            }
            pushes.path_m += f64::from(moved_m);
            if !is_touched(&after, to) {
                pushes.gliding_m += f64::from(moved_m);
            }
            is_tipping |= is_tipped(to);
        }
        before = after;
    }
    pushes.n_tipping = usize::from(is_tipping);
    Ok(pushes)
}

/// Returns true if the end effector of `arm` is above its cube rather than beside it.
fn is_above(scene: &Scene, arm: ArmIndex) -> bool {
    let (hand, cube) = (scene.arms[arm.0].end_effector, &scene.objects[arm.0]);
    let half_m = cube.half_extents_m[0];
    let [x, y, z] = std::array::from_fn(|axis| hand[axis] - cube.centre[axis]);
    x.abs() < half_m && y.abs() < half_m && z > 0.5 * half_m
}

/// Returns true if the palm or a pad of any arm is within 4 mm of `cube`.
fn is_touched(scene: &Scene, cube: &Cuboid) -> bool {
    let (cube_pose, cube_shape) = placed(cube);
    scene.arms.iter().flat_map(|arm| &arm.hand).any(|part| {
        let (pose, shape) = placed(part);
        let gap = query::distance(&cube_pose, &*cube_shape.0, &pose, &*shape.0);
        gap.is_ok_and(|gap| gap.distance <= TOUCHES_M)
    })
}

fn placed(cuboid: &Cuboid) -> (Pose, SharedShape) {
    let [x, y, z, w] = cuboid.orientation;
    let rotation = Rotation::from_xyzw(x, y, z, w);
    let [half_x, half_y, half_z] = cuboid.half_extents_m;
    let pose = Pose::from_parts(Vector::from_array(cuboid.centre), rotation);
    (pose, SharedShape::cuboid(half_x, half_y, half_z))
}

/// Returns true if the cube's vertical axis is more than 45 degrees off every axis on which it could rest.
fn is_tipped(cube: &Cuboid) -> bool {
    let [x, y, z, w] = cube.orientation;
    let up = [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)];
    up.iter().all(|component| component.abs() < TIPPED_COSINE)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cube_is_touched_within_4_mm_of_a_hand_in_any_orientation() {
        let mut scene =
            Env::new(tandem_core::Layout::new(tandem_core::Task::Push, 1), &WorldConfig::default())
                .expect("a world")
                .scene();
        let half = [0.02; 3];
        let pad = |centre, orientation| Cuboid { centre, orientation, half_extents_m: half };
        let upright = [0.0, 0.0, 0.0, 1.0];
        let cube = pad([0.0, 0.0, 0.02], upright);
        let eighth = std::f32::consts::FRAC_PI_8;
        let turned = [0.0, 0.0, eighth.sin(), eighth.cos()];
        // The corner of a box that is turned by 45 degrees is sqrt(2) * 2 cm from its centre.
        for (x_m, orientation, expected) in [
            (0.0439, upright, true),
            (0.0441, upright, false),
            (0.0521, turned, true),
            (0.0524, turned, false),
        ] {
            scene.arms[0].hand = vec![pad([x_m, 0.0, 0.02], orientation)];
            assert_eq!(is_touched(&scene, &cube), expected, "at {x_m} m");
        }
    }
}
