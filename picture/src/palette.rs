//! Colours of a file with at most 256 of them.

use color_quant::NeuQuant;

use crate::raster::Raster;

/// Index that stands for a pixel that does not change.
pub(crate) const UNCHANGED: u8 = 255;
/// Number of colours, so that [`UNCHANGED`] remains free.
const N_COLORS: usize = 255;
/// Bits of a channel that the table of nearest colours distinguishes.
const TABLE_BITS: u32 = 6;
/// The network learns from every pixel.
const SAMPLING: i32 = 1;

/// Colours, and the nearest of them for every colour.
pub(crate) struct Palette {
    /// Red, green and blue of each colour, shape `[256, 3]`.
    pub(crate) rgb: Vec<u8>,
    /// Index of the nearest colour, by the upper bits of red, green and blue.
    nearest: Vec<u8>,
}

impl Palette {
    /// Chooses the colours that represent `samples` best. A colour weighs by the logarithm of its pixels, so that
    /// highlights are not lost beside the background.
    pub(crate) fn of(samples: &[Raster]) -> Self {
        let mut n_pixels = vec![0_u32; 1 << (3 * TABLE_BITS)];
        for rgb in samples.iter().flat_map(|sample| sample.rgb.chunks_exact(3)) {
            n_pixels[key(rgb)] += 1;
        }
        let counted = (0_u32..).zip(n_pixels).filter(|(_, n)| *n > 0);
        let rgba: Vec<u8> = counted
            .flat_map(|(key, n)| std::iter::repeat_n(color(key), 1 + n.ilog2() as usize))
            .flatten()
            .collect();
        let network = NeuQuant::new(SAMPLING, N_COLORS, &rgba);
        let mut rgb = network.color_map_rgb();
        rgb.resize(3 * (N_COLORS + 1), 0);
        let n_entries = 1_u32 << (3 * TABLE_BITS);
        let nearest = (0..n_entries).map(|key| {
            let index = network.index_of(&color(key));
            u8::try_from(index.min(N_COLORS - 1)).unwrap_or(u8::MAX)
        });
        let nearest = nearest.collect();
        Self { rgb, nearest }
    }

    /// Returns the index of the colour of each pixel, shape `[height, width]`.
    pub(crate) fn indices(&self, raster: &Raster) -> Vec<u8> {
        raster.rgb.chunks_exact(3).map(|rgb| self.nearest[key(rgb)]).collect()
    }
}

/// Returns the place of a colour in the table of nearest colours.
fn key(rgb: &[u8]) -> usize {
    rgb.iter().fold(0, |key, channel| key << TABLE_BITS | usize::from(channel >> (8 - TABLE_BITS)))
}

/// Returns red, green, blue and opacity of the colour at place `key` of the table.
fn color(key: u32) -> [u8; 4] {
    [channel(key, 2), channel(key, 1), channel(key, 0), u8::MAX]
}

/// Returns the middle of the range of a channel at place `key` of the table: 2 is red, 0 blue.
#[expect(clippy::cast_possible_truncation, reason = "masked to a byte")]
fn channel(key: u32, channel: u32) -> u8 {
    let upper = key >> (channel * TABLE_BITS) & ((1 << TABLE_BITS) - 1);
    let step = 8 - TABLE_BITS;
    (upper << step | 1 << (step - 1)) as u8
}
