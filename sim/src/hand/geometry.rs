//! The shapes of the hands: palm, fingers and pads.

use rapier3d::math::Vector;

/// Number of fingers in an observation.
pub(crate) const N_OBSERVED_FINGERS: usize = 3;

/// Position and mass of a finger.
#[derive(Debug)]
pub(crate) struct FingerGeometry {
    /// Side of the hand, arm frame: 1 or −1 along y.
    pub(super) side: f32,
    pub(super) x_m: f32,
    pub(super) mass_kg: f32,
}

/// The palm: a box, and in the classic world a capsule for the wrist.
#[derive(Debug)]
pub(crate) struct PalmGeometry {
    /// Half extents of the box, metres.
    pub(crate) half: Vector,
    /// Distance of its centre behind the end effector, against the direction in which the hand points, metres.
    pub(crate) behind_m: f32,
    /// Whether there is a wrist: between [`WRIST_ABOVE_M`], with [`WRIST_RADIUS_M`].
    pub(crate) has_wrist: bool,
}

/// The palm of a hand, the fingers of its gripper and their pads.
#[derive(Debug)]
pub(crate) struct HandGeometry {
    pub(crate) palm: PalmGeometry,
    /// At most [`N_OBSERVED_FINGERS`].
    pub(crate) fingers: &'static [FingerGeometry],
    /// For each observed finger the index of the one that it shows.
    pub(super) observed: [usize; N_OBSERVED_FINGERS],
    /// Half extents of a finger pad (x, closing direction, z), metres.
    pub(crate) pad_half: Vector,
    /// Height of the lower end of a locked gripper's pad whose friction differs from that of the rest, metres; 0 if pads
    /// are of one piece.
    pub(crate) tip_height_m: f32,
    /// Largest opening of each side of the gripper, metres.
    pub(crate) max_opening_m: f32,
    /// Speed of each side at full gripper input, metres per second.
    pub(crate) opening_speed_mps: f32,
}

/// The gripper of the classic world. Two fingers oppose one. Their masses balance, so closing the gripper does not move
/// the hand sideways.
pub(crate) static THREE_FINGERS: HandGeometry = HandGeometry {
    palm: PalmGeometry { half: Vector::new(0.035, 0.06, 0.015), behind_m: 0.065, has_wrist: true },
    fingers: &[
        FingerGeometry { side: 1.0, x_m: 0.016, mass_kg: 0.1 },
        FingerGeometry { side: 1.0, x_m: -0.016, mass_kg: 0.1 },
        FingerGeometry { side: -1.0, x_m: 0.0, mass_kg: 0.2 },
    ],
    observed: [0, 1, 2],
    pad_half: Vector::new(0.010, 0.010, 0.020),
    tip_height_m: 0.0,
    max_opening_m: 0.040,
    opening_speed_mps: 0.25,
};

/// The hand of the shared world: the two fingers and the shell of a Mico, as wide, as far open and as fast as those of the
/// simulated pair of arms in `tandem-trials`. The first finger is observed twice.
pub(crate) static MICO_HAND: HandGeometry = HandGeometry {
    palm: PalmGeometry {
        half: Vector::new(0.030, 0.035, 0.050),
        behind_m: 0.131,
        has_wrist: false,
    },
    fingers: &[
        FingerGeometry { side: 1.0, x_m: 0.0, mass_kg: 0.2 },
        FingerGeometry { side: -1.0, x_m: 0.0, mass_kg: 0.2 },
    ],
    observed: [0, 0, 1],
    pad_half: Vector::new(0.008, 0.005, 0.015),
    tip_height_m: 0.003,
    max_opening_m: 0.062,
    opening_speed_mps: 0.062,
};

impl HandGeometry {
    /// Returns the distance along x from the centre of the hand to the outer edge of its pads, metres.
    pub(crate) fn reach_m(&self) -> f32 {
        let outermost_m = self.fingers.iter().map(|finger| finger.x_m.abs()).fold(0.0, f32::max);
        outermost_m + self.pad_half.x
    }
}
