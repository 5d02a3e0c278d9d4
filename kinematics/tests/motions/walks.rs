//! Random walks of two arms, like those of a policy.

use nalgebra::{Point3, Vector3};
use rand::RngExt as _;
use rand_chacha::ChaCha8Rng;
use tandem_core::{ArmIndex, Stream, episode_rng};
use tandem_kinematics::trajectory::DEFAULT_RATE_HZ;
use tandem_kinematics::{
    ArmWaypoint, Joints, Motion, PlanSettings, Trajectory, Waypoint, WorkCell, plan,
};

/// Longest step of a walk, metres: that of one action.
const STEP_M: f64 = 0.05;

/// A box in the arm frame, metres of the training world.
#[derive(Clone, Copy)]
pub(crate) struct Area {
    pub(crate) low: Vector3<f64>,
    pub(crate) high: Vector3<f64>,
}

impl Area {
    /// The area of objects and goals, up to the highest goal.
    pub(crate) const TASKS: Self =
        Self { low: Vector3::new(-0.12, -0.12, 0.022), high: Vector3::new(0.12, 0.12, 0.27) };
    /// The half of that area far from the other arm, where grippers may rotate freely.
    pub(crate) const FAR: Self =
        Self { low: Vector3::new(-0.12, -0.12, 0.05), high: Vector3::new(0.0, 0.12, 0.20) };

    pub(crate) fn point(&self, rng: &mut ChaCha8Rng) -> Vector3<f64> {
        let share = Vector3::from([0; 3].map(|_| rng.random_range(0.0..1.0)));
        self.low + (self.high - self.low).component_mul(&share)
    }
}

/// Returns `n` waypoints of both arms: steps of up to 5 cm within the area, and a new gripper opening every 7 steps.
pub(crate) fn walk(cell: &WorkCell, area: Area, seed: u64, n: usize) -> Vec<Waypoint> {
    let mut rng = episode_rng(seed, 0, Stream::Exploration);
    let mut in_arm: Vec<Vector3<f64>> = cell.arms.iter().map(|_| area.point(&mut rng)).collect();
    let mut opening = 1.0;
    let longest = STEP_M / cell.task_frame.scale;
    (0..n)
        .map(|step| {
            if step > 0 {
                for in_arm in &mut in_arm {
                    let random = Vector3::from([0; 3].map(|_| rng.random_range(-1.0..1.0)));
                    let moved = *in_arm + random.cap_magnitude(1.0) * longest;
                    *in_arm = moved.sup(&area.low).inf(&area.high);
                }
            }
            if step % 7 == 6 {
                opening = rng.random_range(0.0..=1.0);
            }
            let waypoint = |(arm, in_arm): (usize, &Vector3<f64>)| ArmWaypoint {
                tool_in_world_m: cell.world_from_arm(ArmIndex(arm), &Point3::from(*in_arm)),
                gripper_opening: opening,
            };
            in_arm.iter().enumerate().map(waypoint).collect()
        })
        .collect()
}

/// Plans the walk from configurations with the elbow up.
pub(crate) fn planned(
    cell: &WorkCell,
    waypoints: &[Waypoint],
    settings: &PlanSettings,
) -> Trajectory {
    let start = cell.ready(0.15).unwrap();
    plan(cell, waypoints, &start, settings).unwrap()
}

/// Returns the walk as samples, and the joint angles at its start.
pub(crate) fn sampled(cell: &WorkCell, waypoints: &[Waypoint]) -> (Motion, Vec<Joints>) {
    let motion = planned(cell, waypoints, &PlanSettings::default()).sampled(DEFAULT_RATE_HZ);
    let at = motion.arms.iter().map(|samples| samples[0].angles).collect();
    (motion, at)
}
