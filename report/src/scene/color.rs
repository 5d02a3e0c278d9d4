//! Colours, and how the light changes them.

use super::camera::{Vec3, dot};

/// Where the light comes from: a unit vector, from above, the left and the front.
pub(super) const LIGHT: Vec3 = [-0.36, -0.48, 0.80];

/// A colour, 0 to 255 each.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Rgb(pub(super) u8, pub(super) u8, pub(super) u8);

impl Rgb {
    /// Black at 0, itself at 1, white at 2.
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

/// How bright a face with outward `normal` is, for [`Rgb::lit`].
pub(super) fn brightness(normal: Vec3) -> f64 {
    0.66 + 0.46 * dot(normal, LIGHT).max(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn light_never_leaves_the_range_of_colours() {
        assert_eq!(Rgb(200, 100, 0).lit(0.5), Rgb(100, 50, 0));
        assert_eq!(Rgb(200, 100, 0).lit(2.0), Rgb(255, 255, 255));
        assert_eq!(Rgb(200, 100, 0).lit(9.0), Rgb(255, 255, 255));
    }
}
