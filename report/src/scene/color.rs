//! Colours and shading.

use super::camera::{Vec3, dot};

/// Direction towards the light, a unit vector: above, left and in front.
pub(super) const LIGHT: Vec3 = [-0.36, -0.48, 0.80];

/// A colour: red, green and blue, 0 to 255.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Rgb(pub(super) u8, pub(super) u8, pub(super) u8);

impl Rgb {
    /// Changes the brightness: 0 is black, 1 the colour itself, 2 white.
    pub(super) fn lit(self, brightness: f64) -> Self {
        let channel = |value: u8| {
            let value = f64::from(value);
            let lit = if brightness <= 1.0 {
                value * brightness
            } else {
                value + (255.0 - value) * (brightness - 1.0)
            };
            to_u8(lit)
        };
        Self(channel(self.0), channel(self.1), channel(self.2))
    }

    /// Formats the colour for SVG.
    pub(super) fn hex(self) -> String {
        format!("#{:02x}{:02x}{:02x}", self.0, self.1, self.2)
    }
}

#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "clamped to 0..=255 first"
)]
fn to_u8(value: f64) -> u8 {
    value.round().clamp(0.0, 255.0) as u8
}

/// Returns the brightness of a face with outward `normal`, for [`Rgb::lit`].
pub(super) fn brightness(normal: Vec3) -> f64 {
    0.66 + 0.46 * dot(normal, LIGHT).max(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_lit_colour_stays_in_range() {
        assert_eq!(Rgb(200, 100, 0).lit(0.5), Rgb(100, 50, 0));
        assert_eq!(Rgb(200, 100, 0).lit(2.0), Rgb(255, 255, 255));
        assert_eq!(Rgb(200, 100, 0).lit(9.0), Rgb(255, 255, 255));
    }
}
