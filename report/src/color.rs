//! Colours of the arms in plots.

/// Red, green and blue of the arms and of their objects and goals, those of pictures of the simulator; further arms
/// reuse them.
const ARM_COLORS: [[f64; 3]; 3] =
    [[47.0, 120.0, 189.0], [224.0, 128.0, 51.0], [60.0, 154.0, 102.0]];

/// Returns the colour of an arm for SVG; darker for a `brightness` below 1, lighter above 1, white at 2.
pub(crate) fn arm_color(arm: usize, brightness: f64) -> String {
    let lit = |value: f64| match brightness {
        ..=1.0 => value * brightness,
        _ => value + (255.0 - value) * (brightness - 1.0),
    };
    let [red, green, blue] = ARM_COLORS[arm % ARM_COLORS.len()].map(|value| to_u8(lit(value)));
    format!("#{red:02x}{green:02x}{blue:02x}")
}

#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "clamped to 0..=255 first"
)]
fn to_u8(value: f64) -> u8 {
    value.round().clamp(0.0, 255.0) as u8
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_lit_colour_stays_in_range() {
        assert_eq!(arm_color(0, 0.5), "#183c5f");
        assert_eq!([2.0, 9.0].map(|brightness| arm_color(1, brightness)), ["#ffffff"; 2]);
    }
}
