//! Numbers on the command line.

/// The largest integer of a run file: that of TOML.
const MAX: u64 = i64::MAX.cast_unsigned();

/// Parses a whole number, also with `_` between its digits or with an exponent: 100000, `100_000`, 1e5 or 1.5e6.
pub(super) fn whole(text: &str) -> Result<u64, String> {
    parse(text).filter(|number| *number <= MAX).ok_or_else(|| {
        "expected a whole number below 2^63, such as 100000, 100_000 or 1e5".to_owned()
    })
}

/// Parses a seed of a run.
pub(super) fn seed(text: &str) -> Result<u64, String> {
    let seed = text.parse().ok().filter(|seed| *seed <= MAX);
    seed.ok_or_else(|| "expected a whole number below 2^63".to_owned())
}

fn parse(text: &str) -> Option<u64> {
    let is_number = |part: &str| !part.is_empty() && part.bytes().all(|byte| byte.is_ascii_digit());
    let (mantissa, exponent) = text.split_once(['e', 'E']).unwrap_or((text, "0"));
    let (whole, fraction) = mantissa.split_once('.').unwrap_or((mantissa, "0"));
    if !whole.split('_').chain([fraction, exponent]).all(is_number) {
        return None;
    }
    let fraction = fraction.trim_end_matches('0');
    let number: u64 = format!("{}{fraction}", whole.replace('_', "")).parse().ok()?;
    let n_zeros = exponent.parse::<u32>().ok()?.checked_sub(u32::try_from(fraction.len()).ok()?)?;
    number.checked_mul(10_u64.checked_pow(n_zeros)?)
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
            ("1.50e1", 15),
            ("1.0", 1),
            ("9223372036854775807", MAX),
        ] {
            assert_eq!(whole(text), Ok(number), "{text}");
        }
        let not_whole =
            ["", "-1", "+1", "1.5", "1.", ".5", "1e-3", "1e", "1e+3", "nan", "1,000", "0x10"];
        let underscores = ["_1", "1_", "1__0", "1_e5"];
        let too_large = ["1e19", "1e20", "1e99", "9223372036854775808", "18446744073709551616"];
        for text in not_whole.iter().chain(&underscores).chain(&too_large) {
            assert!(whole(text).is_err(), "{text}");
        }
        assert_eq!(seed("9223372036854775807"), Ok(MAX));
        for text in ["9223372036854775808", "1e5", "-1"] {
            assert!(seed(text).is_err(), "{text}");
        }
    }
}
