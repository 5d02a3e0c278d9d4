//! Pixels.

/// A picture: rows from top to bottom, pixels from left to right.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Raster {
    /// Width, pixels.
    pub width: usize,
    /// Height, pixels.
    pub height: usize,
    /// Red, green and blue, shape `[height, width, 3]`.
    pub rgb: Vec<u8>,
}

#[cfg(feature = "files")]
impl Raster {
    /// Creates a picture of one colour.
    pub(crate) fn filled(width: usize, height: usize, color: [u8; 3]) -> Self {
        Self { width, height, rgb: color.repeat(width * height) }
    }

    /// Mixes `color` into the pixel in column `x` and row `y`; `opacity` is 0 to 255. A place outside is ignored.
    pub(crate) fn blend(&mut self, x: usize, y: usize, color: [u8; 3], opacity: u8) {
        if x >= self.width || y >= self.height {
            return;
        }
        let start = 3 * (y * self.width + x);
        let opacity = u16::from(opacity);
        for (channel, of_color) in self.rgb[start..start + 3].iter_mut().zip(color) {
            let mixed = u16::from(*channel) * (255 - opacity) + u16::from(of_color) * opacity;
            *channel = u8::try_from((mixed + 127) / 255).unwrap_or(u8::MAX);
        }
    }

    /// Copies `other` with its upper left corner at column `left` and row `top`.
    ///
    /// # Panics
    /// If `other` extends beyond this picture.
    pub(crate) fn paste(&mut self, other: &Self, left: usize, top: usize) {
        assert!(left + other.width <= self.width && top + other.height <= self.height, "inside");
        for (row_idx, row) in other.rgb.chunks_exact(3 * other.width).enumerate() {
            let start = 3 * ((top + row_idx) * self.width + left);
            self.rgb[start..start + row.len()].copy_from_slice(row);
        }
    }
}
