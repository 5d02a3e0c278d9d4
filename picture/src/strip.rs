//! Film strips and single pictures as PNG files.

use rayon::iter::{IntoParallelRefIterator as _, ParallelIterator as _};

use crate::error::Error;
use crate::film::{Film, FilmEpisode, FilmStep, draw_step};
use crate::palette::Palette;
use crate::raster::Raster;

/// Number of pictures of an episode in a film strip.
pub const STRIP_PICTURES: usize = 8;
/// Number of pictures side by side.
const N_COLUMNS: usize = 4;
/// Gap between pictures, pixels.
const GAP_PX: usize = 6;
const GAP_COLOR: [u8; 3] = [255; 3];

/// Returns a film strip of `episodes` as a PNG: for each, [`STRIP_PICTURES`] moments from the first until everything
/// is at rest, equally far apart, in rows of four. An episode with fewer moments has fewer pictures.
///
/// # Errors
/// If there is no scene, or the size in `film` is out of range.
pub fn film_strip(episodes: &[FilmEpisode], film: &Film) -> Result<Vec<u8>, Error> {
    let film = film.checked()?;
    let size = (film.width, film.height);
    let rows: Vec<Vec<Moment<'_>>> = episodes.iter().flat_map(rows_of).collect();
    if rows.is_empty() {
        return Err(Error::NoScenes);
    }
    let drawn: Vec<Vec<Raster>> =
        rows.par_iter().map(|row| row.iter().map(|moment| moment.draw(size)).collect()).collect();
    let n_columns = drawn.iter().map(Vec::len).max().unwrap_or(1);
    let along = |n: usize, length: usize| n * length + (n - 1) * GAP_PX;
    let (width, height) = (along(n_columns, size.0), along(drawn.len(), size.1));
    let mut strip = Raster::filled(width, height, GAP_COLOR);
    for (row_idx, row) in drawn.iter().enumerate() {
        for (column_idx, raster) in row.iter().enumerate() {
            strip.paste(raster, column_idx * (size.0 + GAP_PX), row_idx * (size.1 + GAP_PX));
        }
    }
    png(&strip)
}

/// Returns a picture of one moment as a PNG, with `title` in its upper left corner. `size` is width and height, pixels.
///
/// # Errors
/// If the size is out of range.
pub fn picture_png(title: &str, step: &FilmStep, size: (usize, usize)) -> Result<Vec<u8>, Error> {
    let film = Film { width: size.0, height: size.1, speed: 1.0 }.checked()?;
    let raster = draw_step(title, step, false, (film.width, film.height));
    let mut bytes = Vec::new();
    let mut encoder = png_encoder(&mut bytes, &raster);
    encoder.set_color(png::ColorType::Rgb);
    let mut writer = encoder.write_header()?;
    writer.write_image_data(&raster.rgb)?;
    writer.finish()?;
    Ok(bytes)
}

/// A picture of a strip.
struct Moment<'a> {
    title: &'a str,
    step: &'a FilmStep,
    is_last: bool,
}

impl Moment<'_> {
    fn draw(&self, size: (usize, usize)) -> Raster {
        draw_step(self.title, self.step, self.is_last, size)
    }
}

/// Returns the pictures of an episode, row by row. The first has the title.
fn rows_of(episode: &FilmEpisode) -> Vec<Vec<Moment<'_>>> {
    let steps = episode.moving();
    let n_steps = steps.len();
    let n_pictures = n_steps.min(STRIP_PICTURES);
    let chosen = (0..n_pictures).map(|idx| {
        let last_idx = n_pictures.saturating_sub(1).max(1);
        (idx * (n_steps - 1) + last_idx / 2) / last_idx
    });
    let moments = chosen.enumerate().map(|(idx, step_idx)| Moment {
        title: if idx == 0 { &episode.title } else { "" },
        step: &steps[step_idx],
        is_last: step_idx + 1 == n_steps,
    });
    let mut rows: Vec<Vec<Moment<'_>>> = Vec::new();
    for (idx, moment) in moments.enumerate() {
        match rows.last_mut() {
            Some(row) if idx % N_COLUMNS > 0 => row.push(moment),
            _ => rows.push(vec![moment]),
        }
    }
    rows
}

/// Encodes a picture with at most 255 colours.
fn png(raster: &Raster) -> Result<Vec<u8>, Error> {
    let palette = Palette::of(std::slice::from_ref(raster));
    let mut bytes = Vec::new();
    let mut encoder = png_encoder(&mut bytes, raster);
    encoder.set_color(png::ColorType::Indexed);
    encoder.set_palette(palette.rgb.clone());
    let mut writer = encoder.write_header()?;
    writer.write_image_data(&palette.indices(raster))?;
    writer.finish()?;
    Ok(bytes)
}

fn png_encoder<'a>(bytes: &'a mut Vec<u8>, raster: &Raster) -> png::Encoder<'a, &'a mut Vec<u8>> {
    let size = |pixels: usize| u32::try_from(pixels).unwrap_or(u32::MAX);
    let mut encoder = png::Encoder::new(bytes, size(raster.width), size(raster.height));
    encoder.set_depth(png::BitDepth::Eight);
    encoder.set_compression(png::Compression::High);
    encoder
}
