//! The order in which two arms push their objects.
//!
//! Objects that are pushed at the same time can meet, and one can end where no hand gets behind it. One arm therefore
//! waits from the start of an episode if an object or a goal lies in the way of the other object. The starts of the
//! shared world leave both paths free in at least one order.

use glam::DVec2;
use tandem_core::ArmIndex;

use super::ClosedLoop;
use crate::trial::outcome::FailureCause;

/// The horizontal distance from the path of an object below which another object is in its way, metres.
const CLEARANCE_M: f64 = 0.10;
/// The distance from the withdrawn position within which a hand can wait, metres. Elsewhere it could block the other
/// arm.
const WITHDRAWAL_TOLERANCE_M: f64 = 0.05;

/// The straight path of an object to its goal, seen from above, world frame, metres.
#[derive(Debug, Clone, Copy)]
struct ObjectPath {
    from: DVec2,
    to: DVec2,
}

impl ClosedLoop<'_, '_> {
    /// Withdraws and parks the arm whose object is to be pushed last, if the order matters. Its turn comes when the
    /// other object lies at its goal.
    pub(super) fn order_arms(&mut self) -> Result<(), FailureCause> {
        let (runner, start) = (self.runner, self.start);
        // Hands that grasp lift their objects over others.
        if runner.task.shares_object() || runner.config.layout.task.grasps() {
            return Ok(());
        }
        let objects = self.rig.observe_objects()?;
        if !runner.misplaced(&objects, start).all(|misplaced| misplaced) {
            return Ok(());
        }
        let paths = objects.iter().zip(&start.goals).enumerate().map(|(arm, (object, goal))| {
            let to = runner.mapping.object_in_world(ArmIndex(arm), *goal);
            ObjectPath { from: object.at_m.truncate(), to: to.truncate() }
        });
        let paths: Vec<ObjectPath> = paths.collect();
        let Some(waiting) = waiting_arm(&paths) else { return Ok(()) };
        let place = runner.mapping.withdrawn_hand(runner.hands(&self.state)[waiting]);
        let waits: Vec<bool> = (0..paths.len()).map(|arm| arm == waiting).collect();
        self.retreat(&waits)?;
        self.state.before = None;
        if runner.hands(&self.state)[waiting].distance(place) < WITHDRAWAL_TOLERANCE_M {
            self.state.parked = waits;
        }
        Ok(())
    }
}

/// Returns the arm whose object is to be pushed last, or `None` if the order does not matter.
fn waiting_arm(paths: &[ObjectPath]) -> Option<usize> {
    let [one, other] = paths else { return None };
    let (one_m, other_m) = (one.room_m(other), other.room_m(one));
    (one_m.min(other_m) < CLEARANCE_M).then_some(usize::from(one_m >= other_m))
}

impl ObjectPath {
    /// Returns the smallest distance between the objects, metres, if this one is pushed first and the `second` one
    /// after it.
    fn room_m(&self, second: &Self) -> f64 {
        self.distance_m(second.from).min(second.distance_m(self.to))
    }

    /// Returns the distance of `point` from the nearest point of the path, metres.
    fn distance_m(&self, point: DVec2) -> f64 {
        let along = self.to - self.from;
        let offset = point - self.from;
        let share = offset.dot(along) / along.length_squared().max(f64::MIN_POSITIVE);
        offset.distance(along * share.clamp(0.0, 1.0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn path(from: [f64; 2], to: [f64; 2]) -> ObjectPath {
        ObjectPath { from: from.into(), to: to.into() }
    }

    #[test]
    fn arms_with_free_paths_do_not_wait() {
        let paths = [path([0.0, 0.1], [0.2, 0.1]), path([0.2, -0.1], [0.0, -0.1])];
        assert_eq!(waiting_arm(&paths), None);
    }

    #[test]
    fn an_arm_waits_for_an_object_in_its_way() {
        let through = path([0.0, 0.0], [0.2, 0.0]);
        let aside = path([0.1, 0.05], [0.1, 0.2]);
        assert_eq!(waiting_arm(&[through, aside]), Some(0));
        assert_eq!(waiting_arm(&[aside, through]), Some(1));
    }

    #[test]
    fn an_arm_waits_if_its_goal_is_in_the_way_of_the_other_object() {
        let stays = path([0.1, 0.2], [0.1, 0.02]);
        let passes = path([-0.1, 0.0], [0.3, 0.0]);
        assert_eq!(waiting_arm(&[stays, passes]), Some(0));
    }

    #[test]
    fn an_object_at_its_goal_has_a_path_of_no_length() {
        let placed = path([0.0, 0.0], [0.0, 0.0]);
        assert_eq!(placed.distance_m(DVec2::new(0.03, 0.04)), 0.05);
    }
}
