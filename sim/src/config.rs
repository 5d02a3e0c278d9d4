//! What a world is made of.

use serde::{Deserialize, Serialize};

/// How finely a world is simulated and what it is made of.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct WorldConfig {
    /// Physics steps per control step of 0.04 s.
    pub substeps: u32,
}

impl Default for WorldConfig {
    fn default() -> Self {
        Self { substeps: 20 }
    }
}

impl WorldConfig {
    /// The configuration, when every value is in its range.
    ///
    /// # Errors
    /// Names the first value out of range.
    pub fn checked(self) -> Result<Self, SimError> {
        if !(10..=100).contains(&self.substeps) {
            return Err(SimError::Substeps(self.substeps));
        }
        Ok(self)
    }
}

/// How often training episodes start otherwise than evaluated ones. Shares of episodes, in [0, 1].
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Starts {
    /// Share that starts with the object grasped (pick and place).
    pub gripped_share: f32,
    /// Share that starts with the hand anywhere above the table.
    pub wide_share: f32,
}

/// Why a world cannot be built or stepped.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum SimError {
    /// Too few or too many physics steps.
    #[error("{0} physics steps per control step, expected 10 to 100")]
    Substeps(u32),
    /// Worlds have one arm or two.
    #[error("{0} arms, expected 1 or 2")]
    Arms(usize),
}
