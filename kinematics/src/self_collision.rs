//! The parts of one arm that can meet, and how near they may come.
//!
//! Parts that follow each other share a joint and always overlap; the joint's range keeps them apart. Every other pair is
//! looked at, but for those that cannot meet:
//!
//! - Four joints: joint 4 turns the gripper about the forearm's own line, so that its distance from the forearm is fixed.
//! - Six joints: Kinova's own description for MoveIt (`m1n6s200.srdf` and `j2n6s300.srdf` of kinova-ros) lists pairs whose
//!   meshes never touched in random postures: upper arm and first wrist link, forearm and everything from the second
//!   wrist link on, the wrist's links among each other and with the gripper.
//!
//! **Allowances.** A capsule is about a centimetre larger than the part it stands for, so two capsules can overlap where
//! the parts do not. Example `self_gaps` prints the smallest gap of every pair over the joints' ranges. One pair overlaps
//! although Kinova's ranges alone decide about it: the gap between the hand and the upper arm of the Mico with four joints
//! depends on joint 3 only, and the capsules overlap by 23.9 mm at 35 degrees, the end of its range. The actuators there have
//! radii of 37.5 and 29 mm and keep 4.6 mm apart. The pair is therefore judged by these radii, which are
//! 28.5 mm less than those of the capsules. No other pair has an allowance: overlaps of capsules are refused.

use crate::capsule::PosedLinks;
use crate::forward::ForwardKinematics;
use crate::joints::Joints;
use crate::model::ArmModel;

/// The default for the smallest gap between parts of one arm that a motion keeps, metres.
pub const SELF_GAP_M: f64 = 0.005;

/// Two parts of an arm that can meet.
#[derive(Debug)]
pub struct SelfPair {
    /// The parts, as indices of the model's links.
    pub links: [usize; 2],
    /// How much nearer than their capsules the parts may come, metres.
    pub allowance_m: f64,
}

/// What the hand's and the upper arm's capsules have beyond Kinova's actuators of 75 and 58 mm in diameter, metres.
const FOLDED_ALLOWANCE_M: f64 = (0.050 - 0.0375) + (0.045 - 0.029);

/// Base, upper arm, forearm, hand, gripper.
pub(crate) static SELF_PAIRS_4: [SelfPair; 5] =
    [pair(0, 2), pair(0, 3), pair(0, 4), folded(1, 3), pair(1, 4)];

/// Base, upper arm, forearm, two links of the wrist, hand, gripper.
pub(crate) static SELF_PAIRS_6: [SelfPair; 8] = [
    pair(0, 2),
    pair(0, 3),
    pair(0, 4),
    pair(0, 5),
    pair(0, 6),
    pair(1, 4),
    pair(1, 5),
    pair(1, 6),
];

const fn pair(first: usize, second: usize) -> SelfPair {
    SelfPair { links: [first, second], allowance_m: 0.0 }
}

const fn folded(first: usize, second: usize) -> SelfPair {
    SelfPair { links: [first, second], allowance_m: FOLDED_ALLOWANCE_M }
}

impl ArmModel {
    /// The smallest gap between two parts of the arm that can meet, metres (negative when they overlap), with its joints at
    /// `angles` (radians) and the gripper open by `opening` (0 to 1).
    ///
    /// # Panics
    /// When `angles` are of an arm with another number of joints.
    #[must_use]
    pub fn self_gap_m(&self, angles: &Joints, opening: f64) -> f64 {
        PosedLinks::in_base(self, &ForwardKinematics::new(self, angles)).self_gap_m(self, opening).0
    }
    /// The same for one of [`self_pairs`](Self::self_pairs).
    ///
    /// # Panics
    /// When there is no such pair, or `angles` are of an arm with another number of joints.
    #[must_use]
    pub fn pair_gap_m(&self, pair: usize, angles: &Joints, opening: f64) -> f64 {
        let links = PosedLinks::in_base(self, &ForwardKinematics::new(self, angles));
        links.pair_gap_m(self, &self.self_pairs[pair], opening, f64::INFINITY)
    }
}
