//! Text in pictures.

use noto_sans_mono_bitmap::{FontWeight, RasterHeight, get_raster, get_raster_width};

use crate::raster::Raster;

/// Colour of captions.
pub(crate) const INK: [u8; 3] = [44, 51, 60];
/// Colour of the word `success`.
pub(crate) const GOOD: [u8; 3] = [20, 122, 76];
/// Colour of the word `failure`.
pub(crate) const BAD: [u8; 3] = [184, 62, 26];
/// Pictures from this height on have the larger font, pixels.
const LARGE_FROM_PX: usize = 520;

/// The part of the picture where a text starts or ends.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Corner {
    /// Upper left.
    Left,
    /// Upper right.
    Right,
}

/// Returns `text`, or as much of its beginning as fits beside another text of `n_other` characters on the same line.
pub(crate) fn beside(raster: &Raster, text: &str, n_other: usize) -> String {
    let size = size(raster);
    let n_columns =
        raster.width.saturating_sub(size.val()) / get_raster_width(FontWeight::Regular, size);
    // Two columns part the texts.
    let room = n_columns.saturating_sub(n_other + 2);
    match text.chars().count() {
        n if n <= room => text.to_owned(),
        _ => text.chars().take(room.saturating_sub(2)).chain("..".chars().take(room)).collect(),
    }
}

fn size(raster: &Raster) -> RasterHeight {
    match raster.height {
        ..LARGE_FROM_PX => RasterHeight::Size20,
        _ => RasterHeight::Size32,
    }
}

/// Writes `text` into a corner of `raster`, on the line with this number from the top. Characters that the font lacks, all beyond ASCII, become `?`. A text
/// that is too wide is cut off.
pub(crate) fn write(raster: &mut Raster, corner: (Corner, usize), text: &str, color: [u8; 3]) {
    let size = size(raster);
    let weight = if color == INK { FontWeight::Regular } else { FontWeight::Bold };
    let (advance, margin) = (get_raster_width(weight, size), size.val() / 2);
    let width = advance * text.chars().count();
    let (corner, line) = corner;
    let top = margin + line * size.val();
    let left = match corner {
        Corner::Left => margin,
        Corner::Right => raster.width.saturating_sub(margin + width),
    };
    for (idx, character) in text.chars().enumerate() {
        let glyph = get_raster(character, weight, size).or_else(|| get_raster('?', weight, size));
        let rows = glyph.iter().flat_map(|glyph| glyph.rows().enumerate());
        for (y, row) in rows {
            for (x, opacity) in row.iter().enumerate().filter(|(_, opacity)| **opacity > 0) {
                raster.blend(left + idx * advance + x, top + y, color, *opacity);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_title_leaves_room_for_the_time() {
        let shown = |width, title: &str| {
            let raster = Raster { width, height: 300, rgb: Vec::new() };
            beside(&raster, title, "12.50 s".len())
        };
        let title = "shared-pick-and-place, episode 12";
        assert_eq!(shown(480, title), title);
        assert_eq!(shown(300, title), "shared-pick-and-plac..");
        assert_eq!(shown(100, title), "");
        assert_eq!(shown(10, title), "");
    }
}
