//! Checks of sizes and numbers that networks and policies share.

use crate::elementwise::all_finite;
use crate::error::Error;
use crate::normalizer::NormalizerSnapshot;

/// Largest accepted number of units per hidden layer.
pub const MAX_HIDDEN: usize = 1 << 14;
/// Largest accepted number of hidden layers.
pub const MAX_HIDDEN_LAYERS: usize = 64;
/// Largest accepted number of critic heads.
pub const MAX_HEADS: usize = 64;

/// Checks the width and the number of hidden layers.
pub(crate) fn check_network_size(n_hidden: usize, n_hidden_layers: usize) -> Result<(), Error> {
    check_size("n_hidden", n_hidden, MAX_HIDDEN)?;
    check_size("n_hidden_layers", n_hidden_layers, MAX_HIDDEN_LAYERS)
}

/// Checks that a size is in `1..=most`.
pub(crate) const fn check_size(name: &'static str, got: usize, most: usize) -> Result<(), Error> {
    if got == 0 || got > most { Err(Error::Size { name, got, most }) } else { Ok(()) }
}

/// Checks that a critic has one value, or one for each of `n_arms` arms.
pub(crate) fn check_heads(n_heads: usize, n_arms: usize) -> Result<(), Error> {
    if [1, n_arms].contains(&n_heads) { Ok(()) } else { Err(Error::Heads { got: n_heads, n_arms }) }
}

/// Checks that there are `expected` parameters and that all are finite.
pub(crate) fn check_parameters(
    name: &'static str,
    parameters: &[f32],
    expected: usize,
) -> Result<(), Error> {
    if parameters.len() != expected {
        return Err(Error::WrongLength { name, got: parameters.len(), expected });
    }
    if all_finite(parameters) { Ok(()) } else { Err(Error::NotFinite { name }) }
}

/// Checks that mean and standard deviation have shape `[size]`, are finite, and that the latter is positive.
pub(crate) fn check_normalizer(
    [mean, std]: [&'static str; 2],
    normalizer: &NormalizerSnapshot,
    size: usize,
) -> Result<(), Error> {
    check_parameters(mean, &normalizer.mean, size)?;
    check_parameters(std, &normalizer.std, size)?;
    if normalizer.std.iter().all(|std| *std > 0.0) {
        Ok(())
    } else {
        Err(Error::NotPositive { name: std })
    }
}
