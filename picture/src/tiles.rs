//! Tiles of a picture, and the bodies that may be visible in each: a ray is compared with few bodies instead of all.

use crate::camera::Rectangle;

/// Width and height of a tile, pixels.
const TILE_PX: usize = 16;

/// The things that may be visible in a tile, as ascending indices.
#[derive(Debug, Clone, Default)]
pub(crate) struct Tile {
    pub(crate) bodies: Vec<usize>,
    pub(crate) shadows: Vec<usize>,
    pub(crate) goals: Vec<usize>,
}

/// The tiles of a picture, row by row.
pub(crate) struct Tiles {
    n_columns: usize,
    tiles: Vec<Tile>,
}

impl Tiles {
    /// Creates empty tiles for a picture of this size, pixels.
    pub(crate) fn new(width: usize, height: usize) -> Self {
        let n_columns = width.div_ceil(TILE_PX);
        Self { n_columns, tiles: vec![Tile::default(); n_columns * height.div_ceil(TILE_PX)] }
    }

    /// Adds the index of each rectangle to the `list` of all tiles that it overlaps.
    pub(crate) fn add<'a>(
        &mut self,
        bounds: impl Iterator<Item = &'a Rectangle>,
        list: impl Fn(&mut Tile) -> &mut Vec<usize>,
    ) {
        if self.tiles.is_empty() {
            return;
        }
        let n_rows = self.tiles.len() / self.n_columns;
        for (idx, Rectangle { low, high }) in bounds.enumerate() {
            for row in tile_of(low[1])..=tile_of(high[1]).min(n_rows - 1) {
                for column in tile_of(low[0])..=tile_of(high[0]).min(self.n_columns - 1) {
                    list(&mut self.tiles[row * self.n_columns + column]).push(idx);
                }
            }
        }
    }

    /// Returns the tile of a pixel.
    pub(crate) fn at(&self, x: usize, y: usize) -> &Tile {
        &self.tiles[(y / TILE_PX) * self.n_columns + x / TILE_PX]
    }
}

/// Returns the row or column of the tile that contains a coordinate; 0 for those before the picture.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    clippy::cast_precision_loss,
    reason = "saturates, and tiles are small"
)]
fn tile_of(place_px: f64) -> usize {
    (place_px / TILE_PX as f64) as usize
}
