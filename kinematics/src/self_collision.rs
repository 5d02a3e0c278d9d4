//! Gaps between the parts of one arm.
//!
//! Adjacent parts share a joint and always overlap; the joint's range keeps them apart. A model lists every other pair
//! that can collide ([`ArmModel::self_pairs`]).
//!
//! **Allowances.** A capsule is about a centimetre larger than the part it models, so two capsules can overlap where
//! the parts do not. Example `self_gaps` prints the smallest gap of every pair over the joints' ranges. In one pair the
//! capsules overlap within Kinova's own ranges: the gap between the hand and the upper arm of the Mico with four joints
//! depends on joint 3 alone, and the capsules overlap by 23.9 mm at 35 degrees, the end of its range. The actuators
//! there have radii of 37.5 and 29 mm and are 4.6 mm apart. That pair is therefore judged by the actuators' radii,
//! which are 28.5 mm less than those of the capsules. No other pair has an allowance: overlapping capsules are refused.

use nalgebra::Isometry3;

use crate::capsule::LinkCapsules;
use crate::forward::ForwardKinematics;
use crate::joints::Joints;
use crate::model::ArmModel;

/// The default of the smallest gap between parts of one arm that a motion must keep, metres.
pub const SELF_GAP_M: f64 = 0.005;

impl ArmModel {
    /// Returns the smallest gap between two parts of the arm that can collide, metres (negative if they overlap), at
    /// joint angles `angles` (radians) with the gripper open by `gripper_opening` (0 to 1).
    ///
    /// # Panics
    /// If `angles` has another number of joints than the arm.
    #[must_use]
    pub fn self_gap_m(&self, angles: &Joints, gripper_opening: f64) -> f64 {
        self.capsules(angles).self_gap_m(self, gripper_opening).0
    }

    /// Returns the gap of pair `pair` of [`self_pairs`](Self::self_pairs), metres (negative if the parts overlap).
    ///
    /// # Panics
    /// If there is no such pair, or `angles` has another number of joints than the arm.
    #[must_use]
    pub fn pair_gap_m(&self, pair: usize, angles: &Joints, gripper_opening: f64) -> f64 {
        let pair = &self.self_pairs[pair];
        self.capsules(angles).pair_gap_m(self, pair, gripper_opening, f64::INFINITY)
    }

    fn capsules(&self, angles: &Joints) -> LinkCapsules {
        LinkCapsules::new(self, &ForwardKinematics::new(self, angles), &Isometry3::identity())
    }
}
