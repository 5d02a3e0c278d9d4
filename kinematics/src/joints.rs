//! One value per joint of an arm.

use std::fmt;
use std::ops::{Deref, DerefMut};

/// The largest number of joints of an arm.
pub const MAX_JOINTS: usize = 6;

/// One value per joint of an arm, base to wrist: angles in radians, velocities in radians per second, or torques in
/// newton metres.
///
/// Dereferences to a slice of `n_joints` values.
#[derive(Clone, Copy, PartialEq)]
pub struct Joints {
    values: [f64; MAX_JOINTS],
    n: usize,
}

impl Joints {
    /// Copies `values`, base to wrist.
    ///
    /// # Panics
    /// If there are more than [`MAX_JOINTS`] values.
    #[must_use]
    pub fn new(values: &[f64]) -> Self {
        Self::from_fn(values.len(), |joint| values[joint])
    }

    /// Calls `value` with the index of each of `n_joints` joints.
    ///
    /// # Panics
    /// If `n_joints` exceeds [`MAX_JOINTS`].
    #[must_use]
    pub fn from_fn(n_joints: usize, mut value: impl FnMut(usize) -> f64) -> Self {
        assert!(n_joints <= MAX_JOINTS, "{n_joints} joints, at most {MAX_JOINTS}");
        let values = std::array::from_fn(|joint| if joint < n_joints { value(joint) } else { 0.0 });
        Self { values, n: n_joints }
    }

    /// Returns `true` if every value is finite.
    #[must_use]
    pub fn is_finite(&self) -> bool {
        self.iter().all(|value| value.is_finite())
    }

    /// Returns the largest absolute difference to `other`, in the unit of the values, over the joints that both have.
    #[must_use]
    pub fn largest_difference(&self, other: &Self) -> f64 {
        self.iter().zip(other.iter()).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
    }
}

impl Deref for Joints {
    type Target = [f64];

    fn deref(&self) -> &[f64] {
        &self.values[..self.n]
    }
}

impl DerefMut for Joints {
    fn deref_mut(&mut self) -> &mut [f64] {
        &mut self.values[..self.n]
    }
}

impl fmt::Debug for Joints {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_list().entries(self.iter()).finish()
    }
}
