//! Random walks of two arms, as a policy makes them.

use glam::DVec3;
use rand::RngExt as _;
use rand_chacha::ChaCha8Rng;
use tandem_core::{ArmIndex, Stream, episode_rng};
use tandem_kinematics::trajectory::DEFAULT_RATE_HZ;
use tandem_kinematics::{
    ArmWaypoint, Joints, Motion, PlanSettings, Trajectory, Waypoint, WorkCell, plan,
};

/// Longest step of a walk, metres: that of an action.
const STEP_M: f64 = 0.05;

/// A box in the own frame, metres of the training world.
#[derive(Clone, Copy)]
pub(crate) struct Area {
    pub(crate) low: DVec3,
    pub(crate) high: DVec3,
}

impl Area {
    /// Where objects and goals may be, and the way up to the highest goal.
    pub(crate) const TASKS: Self =
        Self { low: DVec3::new(-0.12, -0.12, 0.022), high: DVec3::new(0.12, 0.12, 0.27) };
    /// The half of it that is far from the other arm, so that grippers may turn as they like.
    pub(crate) const FAR: Self =
        Self { low: DVec3::new(-0.12, -0.12, 0.05), high: DVec3::new(0.0, 0.12, 0.20) };

    /// Clear of the singular postures that the arms with six joints have low above the table.
    pub(crate) const HIGH: Self =
        Self { low: DVec3::new(-0.08, -0.12, 0.14), high: DVec3::new(0.12, 0.12, 0.27) };

    pub(crate) fn point(&self, rng: &mut ChaCha8Rng) -> DVec3 {
        let share = DVec3::from_array([0; 3].map(|_| rng.random_range(0.0..1.0)));
        self.low + (self.high - self.low) * share
    }
}

/// `n` waypoints of both arms: steps of up to 5 cm within the area, openings that jump now and then.
pub(crate) fn walk(cell: &WorkCell, area: Area, seed: u64, n: usize) -> Vec<Waypoint> {
    let mut rng = episode_rng(seed, 0, Stream::Exploration);
    let mut own: Vec<DVec3> = cell.arms.iter().map(|_| area.point(&mut rng)).collect();
    let mut opening = 1.0;
    let longest = STEP_M / cell.task_frame.scale;
    (0..n)
        .map(|step| {
            if step > 0 {
                for own in &mut own {
                    let random = DVec3::from_array([0; 3].map(|_| rng.random_range(-1.0..1.0)));
                    *own =
                        (*own + random.clamp_length_max(1.0) * longest).clamp(area.low, area.high);
                }
            }
            if step % 7 == 6 {
                opening = rng.random_range(0.0..=1.0);
            }
            let waypoint = |(arm, own): (usize, &DVec3)| ArmWaypoint {
                tool_in_world_m: cell.world_from_own(ArmIndex(arm), *own),
                gripper_opening: opening,
            };
            own.iter().enumerate().map(waypoint).collect()
        })
        .collect()
}

/// The walk's trajectory from postures with the elbow up.
pub(crate) fn planned(
    cell: &WorkCell,
    waypoints: &[Waypoint],
    settings: &PlanSettings,
) -> Trajectory {
    let start = cell.ready(0.15).unwrap();
    plan(cell, waypoints, &start, settings).unwrap()
}

/// The walk as samples, and where the arms have to be before.
pub(crate) fn sampled(cell: &WorkCell, waypoints: &[Waypoint]) -> (Motion, Vec<Joints>) {
    let motion = planned(cell, waypoints, &PlanSettings::default()).sampled(DEFAULT_RATE_HZ);
    let at = motion.arms.iter().map(|samples| samples[0].angles).collect();
    (motion, at)
}
