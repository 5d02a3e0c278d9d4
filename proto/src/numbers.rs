//! Validation of numbers, and conversion of float vectors to bytes (little-endian float32).

use std::ops::RangeInclusive;

use crate::error::DecodeError;

/// Tolerance for actions outside [−1, 1] because of rounding by the sender.
const ACTION_SLACK: f32 = 1e-6;

/// Encodes `values` as little-endian bytes.
pub(crate) fn to_bytes(values: &[f32]) -> Vec<u8> {
    if cfg!(target_endian = "little") {
        bytemuck::cast_slice(values).to_vec()
    } else {
        values.iter().flat_map(|value| value.to_le_bytes()).collect()
    }
}

/// Decodes `n` finite numbers.
pub(crate) fn finite_from_bytes(
    field: &str,
    bytes: &[u8],
    n: usize,
) -> Result<Vec<f32>, DecodeError> {
    finite(field, floats_from_bytes(field, bytes, n)?, n)
}

/// Decodes `n` finite numbers. `largest` returns the bound on the magnitude of the number at an index.
pub(crate) fn bounded_from_bytes(
    field: &str,
    bytes: &[u8],
    n: usize,
    largest: impl Fn(usize) -> f32,
) -> Result<Vec<f32>, DecodeError> {
    bounded(field, floats_from_bytes(field, bytes, n)?, n, largest)
}

/// Decodes `n` components of actions.
pub(crate) fn actions_from_bytes(
    field: &str,
    bytes: &[u8],
    n: usize,
) -> Result<Vec<f32>, DecodeError> {
    actions(field, floats_from_bytes(field, bytes, n)?, n)
}

/// Decodes `n` numbers, which may be of any value.
pub(crate) fn floats_from_bytes(
    field: &str,
    bytes: &[u8],
    n: usize,
) -> Result<Vec<f32>, DecodeError> {
    let (words, rest) = bytes.as_chunks::<4>();
    if !rest.is_empty() {
        let expected = format_args!("{} bytes, 4 per number", 4 * n).to_string();
        return Err(DecodeError::new(field, expected, format_args!("{} bytes", bytes.len())));
    }
    if words.len() != n {
        return Err(wrong_length(field, n, words.len()));
    }
    Ok(words.iter().map(|word| f32::from_le_bytes(*word)).collect())
}

/// Checks that `values` are `n` finite numbers.
pub(crate) fn finite(field: &str, values: Vec<f32>, n: usize) -> Result<Vec<f32>, DecodeError> {
    checked(field, values, n, "a finite number", f32::is_finite)
}

/// Checks that `values` are `n` finite numbers. `largest` returns the bound on the magnitude of the number at an index.
pub(crate) fn bounded(
    field: &str,
    values: Vec<f32>,
    n: usize,
    largest: impl Fn(usize) -> f32,
) -> Result<Vec<f32>, DecodeError> {
    let values = finite(field, values, n)?;
    let beyond = values.iter().enumerate().find(|(idx, value)| value.abs() > largest(*idx));
    match beyond {
        None => Ok(values),
        Some((bad, value)) => {
            let bound = largest(bad);
            let expected = format_args!("a number in [-{bound}, {bound}]").to_string();
            Err(DecodeError::new(format!("{field}[{bad}]"), expected, format_args!("{value:e}")))
        }
    }
}

/// Checks that `values` are `n` finite numbers above 0.
pub(crate) fn positive(field: &str, values: Vec<f32>, n: usize) -> Result<Vec<f32>, DecodeError> {
    checked(field, values, n, "a finite number above 0", |value| value.is_finite() && value > 0.0)
}

/// Checks that `values` are `n` numbers in [−1, 1].
pub(crate) fn actions(field: &str, values: Vec<f32>, n: usize) -> Result<Vec<f32>, DecodeError> {
    checked(field, values, n, "a number in [-1, 1]", |value| value.abs() <= 1.0 + ACTION_SLACK)
}

fn checked(
    field: &str,
    values: Vec<f32>,
    n: usize,
    expected: &str,
    holds: impl Fn(f32) -> bool,
) -> Result<Vec<f32>, DecodeError> {
    if values.len() != n {
        return Err(wrong_length(field, n, values.len()));
    }
    match values.iter().position(|value| !holds(*value)) {
        None => Ok(values),
        Some(bad) => Err(DecodeError::new(format!("{field}[{bad}]"), expected, values[bad])),
    }
}

fn wrong_length(field: &str, expected: usize, got: usize) -> DecodeError {
    DecodeError::new(field, format_args!("{expected} numbers"), format_args!("{got} numbers"))
}

/// Checks that `value` is finite.
pub(crate) fn one_finite(field: &str, value: f32) -> Result<f32, DecodeError> {
    if value.is_finite() {
        Ok(value)
    } else {
        Err(DecodeError::new(field, "a finite number", value))
    }
}

/// Checks that `value` is finite and in `range`.
pub(crate) fn one_within(
    field: &str,
    value: f32,
    range: &RangeInclusive<f32>,
) -> Result<f32, DecodeError> {
    if value.is_finite() && range.contains(&value) {
        return Ok(value);
    }
    let expected = match (range.start(), range.end()) {
        (low, high) if high.is_infinite() => format!("a finite number, {low} or more"),
        (low, high) => format!("a number in [{low}, {high}]"),
    };
    Err(DecodeError::new(field, expected, value))
}

/// Checks that `value` is in `range`.
pub(crate) fn count_within(
    field: &str,
    value: u32,
    range: &RangeInclusive<u32>,
) -> Result<u32, DecodeError> {
    if range.contains(&value) {
        return Ok(value);
    }
    Err(DecodeError::new(field, format_args!("{} to {}", range.start(), range.end()), value))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn floats_travel_as_little_endian_bytes() {
        assert_eq!(to_bytes(&[1.0, -2.5]), [0, 0, 0x80, 0x3f, 0, 0, 0x20, 0xc0]);
        assert_eq!(finite_from_bytes("x", &to_bytes(&[1.0, -2.5]), 2), Ok(vec![1.0, -2.5]));
    }

    #[test]
    fn errors_name_the_index_and_the_value() {
        let check = |outcome: Result<Vec<f32>, DecodeError>, message: &str| {
            assert_eq!(outcome.unwrap_err().to_string(), message);
        };
        check(finite_from_bytes("x", &[0; 9], 2), "x: expected 8 bytes, 4 per number, got 9 bytes");
        check(finite_from_bytes("x", &[0; 12], 2), "x: expected 2 numbers, got 3 numbers");
        check(finite("x", vec![0.0, f32::NAN], 2), "x[1]: expected a finite number, got NaN");
        check(finite("x", vec![f32::NEG_INFINITY], 1), "x[0]: expected a finite number, got -inf");
        let growing = |idx: usize| if idx == 0 { 0.5 } else { 2.5 };
        check(
            bounded("x", vec![0.0, 3e38], 2, growing),
            "x[1]: expected a number in [-2.5, 2.5], got 3e38",
        );
        check(
            bounded("x", vec![-0.75, 0.0], 2, growing),
            "x[0]: expected a number in [-0.5, 0.5], got -7.5e-1",
        );
        check(
            bounded("x", vec![f32::NAN, 9.0], 2, growing),
            "x[0]: expected a finite number, got NaN",
        );
        check(positive("x", vec![1.0, 0.0], 2), "x[1]: expected a finite number above 0, got 0");
        check(actions("x", vec![1.00001], 1), "x[0]: expected a number in [-1, 1], got 1.00001");
        check(actions("x", vec![f32::NAN], 1), "x[0]: expected a number in [-1, 1], got NaN");
    }

    #[test]
    fn numbers_at_their_bound_and_denormals_are_accepted() {
        let values = vec![2.5, -2.5, 1e-45, -0.0];
        assert_eq!(bounded("x", values.clone(), 4, |_| 2.5), Ok(values));
    }

    #[test]
    fn an_action_may_exceed_its_range_by_rounding_only() {
        assert!(actions("x", vec![1.0 + 5e-7, -1.0 - 5e-7], 2).is_ok());
    }

    #[test]
    fn a_single_number_is_checked_against_its_range() {
        let check = |outcome: Result<f32, DecodeError>, message: &str| {
            assert_eq!(outcome.unwrap_err().to_string(), message);
        };
        assert_eq!(one_within("x", 1.0, &(0.0..=1.0)), Ok(1.0));
        check(one_within("x", 1.5, &(0.0..=1.0)), "x: expected a number in [0, 1], got 1.5");
        check(
            one_within("x", f32::INFINITY, &(1.0..=f32::INFINITY)),
            "x: expected a finite number, 1 or more, got inf",
        );
        check(one_finite("x", f32::NAN), "x: expected a finite number, got NaN");
        assert_eq!(
            count_within("n", 0, &(1..=8)).unwrap_err().to_string(),
            "n: expected 1 to 8, got 0"
        );
    }
}
