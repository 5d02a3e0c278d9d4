//! Numbers on the command line.

/// Parses a whole number, also with `_` between its digits or with an exponent: 100000, `100_000` or 1e5.
pub(super) fn whole(text: &str) -> Result<u64, String> {
    let wrong = || "expected a whole number, such as 100000, 100_000 or 1e5".to_owned();
    let has_digits = text.starts_with(|c: char| c.is_ascii_digit()) && !text.ends_with('_');
    let digits = if has_digits { text.replace('_', "") } else { return Err(wrong()) };
    let (mantissa, exponent) = match digits.split_once(['e', 'E']) {
        Some((mantissa, exponent)) => (mantissa, exponent.parse().map_err(|_invalid| wrong())?),
        None => (digits.as_str(), 0),
    };
    let (whole, fraction) = mantissa.split_once('.').unwrap_or((mantissa, ""));
    let n_zeros: u32 = exponent;
    let n_zeros = n_zeros.checked_sub(u32::try_from(fraction.len()).map_err(|_long| wrong())?);
    let number: u64 = format!("{whole}{fraction}").parse().map_err(|_invalid| wrong())?;
    let scale = n_zeros.and_then(|n_zeros| 10_u64.checked_pow(n_zeros));
    scale.and_then(|scale| number.checked_mul(scale)).ok_or_else(wrong)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn whole_numbers_are_exact() {
        for (text, number) in [
            ("0", 0),
            ("100000", 100_000),
            ("100_000", 100_000),
            ("1e5", 100_000),
            ("1.5E6", 1_500_000),
            ("18446744073709551615", u64::MAX),
        ] {
            assert_eq!(whole(text), Ok(number), "{text}");
        }
        for text in
            ["", "-1", "+1", "_1", "1_", "1.5", "1e-3", "1e", "1e99", "nan", "1,000", "0x10"]
        {
            assert!(whole(text).is_err(), "{text}");
        }
    }
}
