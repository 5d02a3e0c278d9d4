//! Checks of the update.
