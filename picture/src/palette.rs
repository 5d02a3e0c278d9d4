//! Colours of a file with at most 256 of them.

use color_quant::NeuQuant;

use crate::raster::Raster;

/// Index that stands for a pixel that does not change.
pub(crate) const UNCHANGED: u8 = 255;
/// Number of colours, so that [`UNCHANGED`] remains free.
const N_COLORS: usize = 255;
/// Number of colours that are those of the pictures exactly.
const N_EXACT: usize = 24;
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
    /// Chooses the colours that represent `samples` best: the most frequent ones exactly, the others by a neural network
    /// in which a colour weighs by the root of its pixels, so that highlights are not lost beside the background.
    pub(crate) fn of(samples: &[Raster]) -> Self {
        let frequent = most_frequent(samples);
        let mut n_pixels = vec![0_u32; 1 << (3 * TABLE_BITS)];
        for rgb in samples.iter().flat_map(|sample| sample.rgb.chunks_exact(3)) {
            n_pixels[key(rgb)] += 1;
        }
        let counted = (0_u32..).zip(n_pixels).filter(|(_, n)| *n > 0);
        let rgba: Vec<u8> = counted
            .flat_map(|(key, n)| std::iter::repeat_n(color(key), 1 + n.isqrt() as usize / 4))
            .flatten()
            .collect();
        let network = NeuQuant::new(SAMPLING, N_COLORS - frequent.len(), &rgba);
        let mut rgb: Vec<u8> = frequent.iter().flatten().copied().collect();
        rgb.extend(network.color_map_rgb());
        rgb.resize(3 * (N_COLORS + 1), 0);
        let n_entries = 1_u32 << (3 * TABLE_BITS);
        let nearest = (0..n_entries).map(|key| {
            let index = frequent.len() + network.index_of(&color(key));
            u8::try_from(index.min(N_COLORS - 1)).unwrap_or(u8::MAX)
        });
        let mut nearest: Vec<u8> = nearest.collect();
        for (index, color) in (0_u8..).zip(&frequent) {
            nearest[key(color)] = index;
        }
        Self { rgb, nearest }
    }

    /// Returns the index of the colour of each pixel, shape `[height, width]`.
    pub(crate) fn indices(&self, raster: &Raster) -> Vec<u8> {
        raster.rgb.chunks_exact(3).map(|rgb| self.nearest[key(rgb)]).collect()
    }
}

/// Returns the [`N_EXACT`] most frequent colours of `samples`, the rarest first.
fn most_frequent(samples: &[Raster]) -> Vec<[u8; 3]> {
    let pixels = samples.iter().flat_map(|sample| sample.rgb.chunks_exact(3));
    let mut colors: Vec<[u8; 3]> = pixels.map(|rgb| [rgb[0], rgb[1], rgb[2]]).collect();
    colors.sort_unstable();
    let counted = colors.chunk_by(|a, b| a == b).map(|same| (same.len(), same[0]));
    let mut counted: Vec<(usize, [u8; 3])> = counted.collect();
    counted.sort_unstable();
    let n_others = counted.len().saturating_sub(N_EXACT);
    counted.into_iter().skip(n_others).map(|(_, color)| color).collect()
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
