//! Films of episodes as animated GIF files.

use gif::{DisposalMethod, Encoder, Frame, Repeat};
use rayon::iter::{IntoParallelRefIterator as _, ParallelIterator as _};
use tandem_core::reward::distance;
use tandem_core::scene::{Point, Scene};

use crate::camera::View;
use crate::caption::{self, BAD, Corner, GOOD, INK};
use crate::error::Error;
use crate::interpolate::between;
use crate::motion::motion_m;
use crate::painter::render_achieved;
use crate::palette::{Palette, UNCHANGED};
use crate::raster::Raster;

/// Time between two frames, hundredths of a second.
const FRAME_CS: u16 = 4;
/// Time for which the first and the last frame of an episode stay, hundredths of a second.
const FIRST_CS: u16 = 30;
const LAST_CS: u16 = 90;
/// Distance from its last position within which a hand or an object counts as at rest, metres.
const REST_M: f32 = 0.01;
/// Number of control steps at rest at the end of an episode that are shown.
const N_RESTING: usize = 3;
/// Motion since an earlier frame up to which a frame shows the bodies as that did, pixels.
const STILL_PX: f64 = 0.25;
/// Maximum number of frames that show the bodies of one frame.
const MAX_STILL: usize = 8;
/// Groups of such frames that are in memory at a time.
const CHUNK: usize = 16;
/// Smallest and largest width and height of a picture, pixels.
const SIZES_PX: std::ops::RangeInclusive<usize> = 64..=4096;
/// Slowest and fastest film.
const SPEEDS: std::ops::RangeInclusive<f64> = 0.05..=20.0;

/// One moment of an episode.
#[derive(Debug, Clone, PartialEq)]
pub struct FilmStep {
    /// The world.
    pub scene: Scene,
    /// True for each arm whose goal is achieved, in arm order.
    pub achieved: Vec<bool>,
}

/// An episode: the world before the first control step and after each. A film ends shortly after everything has come to
/// rest.
#[derive(Debug, Clone, PartialEq)]
pub struct FilmEpisode {
    /// Text in the upper left corner, in ASCII.
    pub title: String,
    /// The moments in order.
    pub steps: Vec<FilmStep>,
}

impl FilmEpisode {
    /// Returns the moments up to shortly after hands and objects have come to rest.
    pub(crate) fn moving(&self) -> &[FilmStep] {
        let Some(last) = self.steps.last() else { return &[] };
        let is_at_rest = |step: &&FilmStep| {
            step.achieved == last.achieved && has_moved_by(&step.scene, &last.scene) < REST_M
        };
        let n_at_rest = self.steps.iter().rev().take_while(is_at_rest).count();
        let n_shown = self.steps.len() - n_at_rest.saturating_sub(N_RESTING);
        &self.steps[..n_shown]
    }
}

/// Returns the largest distance between the places of a hand or an object in two scenes, metres.
fn has_moved_by(one: &Scene, other: &Scene) -> f32 {
    let places = |scene: &Scene| -> Vec<Point> {
        let objects = scene.objects.iter().map(|object| object.centre);
        scene.arms.iter().map(|arm| arm.end_effector).chain(objects).collect()
    };
    let pairs = places(one).into_iter().zip(places(other));
    pairs.map(|(a, b)| distance(&a, &b)).fold(0.0, f32::max)
}

/// Size and speed of a film.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Film {
    /// Width of a picture, 64 to 4096 pixels.
    pub width: usize,
    /// Height of a picture, 64 to 4096 pixels.
    pub height: usize,
    /// Ratio of simulated time to the time of the film, 0.05 to 20: 0.5 shows an episode at half its speed.
    pub speed: f64,
}

impl Film {
    /// Checks size and speed.
    ///
    /// # Errors
    /// If one of them is out of range.
    pub fn checked(self) -> Result<Self, Error> {
        let Self { width, height, speed } = self;
        if !SIZES_PX.contains(&width) || !SIZES_PX.contains(&height) {
            return Err(Error::Size { width, height });
        }
        if !SPEEDS.contains(&speed) {
            return Err(Error::Speed(speed));
        }
        Ok(self)
    }
}

/// A frame that is not drawn yet.
struct Shot<'a> {
    title: &'a str,
    before: &'a FilmStep,
    after: &'a FilmStep,
    /// Share of the way from `before` to `after`, in [0, 1).
    share: f32,
    is_last: bool,
    delay_cs: u16,
}

/// Returns a film of `episodes` as an endless animated GIF with 25 frames per second. Moments between control steps are
/// interpolated.
///
/// # Errors
/// If there is no scene, or `film` is out of range.
pub fn film_gif(episodes: &[FilmEpisode], film: &Film) -> Result<Vec<u8>, Error> {
    film_gif_with(episodes, film, |_, _| {})
}

/// Returns a film as [`film_gif`], and calls `on_progress` with the number of frames so far and of all frames.
///
/// # Errors
/// If there is no scene, or `film` is out of range.
pub fn film_gif_with(
    episodes: &[FilmEpisode],
    film: &Film,
    mut on_progress: impl FnMut(usize, usize),
) -> Result<Vec<u8>, Error> {
    let film = film.checked()?;
    let shots: Vec<Shot<'_>> =
        episodes.iter().flat_map(|episode| shots(episode, film.speed)).collect();
    let (Some(first), Some(last)) = (shots.first(), shots.last()) else {
        return Err(Error::NoScenes);
    };
    let samples = [first, &shots[shots.len() / 2], last].map(|shot| shot.draw(&film));
    let palette = Palette::of(&samples);
    let (width, height) = (to_u16(film.width), to_u16(film.height));
    let mut bytes = Vec::new();
    let mut encoder = Encoder::new(&mut bytes, width, height, &palette.rgb)?;
    encoder.set_repeat(Repeat::Infinite)?;
    let mut shown: Option<Vec<u8>> = None;
    let mut n_written = 0;
    for chunk in still_groups(&shots, &film).chunks(CHUNK) {
        let drawn: Vec<Vec<Vec<u8>>> =
            chunk.par_iter().map(|group| draw_group(group, &film, &palette)).collect();
        for (shot, indices) in chunk.iter().copied().flatten().zip(drawn.into_iter().flatten()) {
            let mut frame = changed_part(shown.as_deref(), &indices, film.width);
            frame.delay = shot.delay_cs;
            encoder.write_frame(&frame)?;
            shown = Some(indices);
            n_written += 1;
            on_progress(n_written, shots.len());
        }
    }
    drop(encoder);
    Ok(bytes)
}

/// Returns the frames of an episode.
#[expect(clippy::cast_possible_truncation, reason = "a share in [0, 1)")]
fn shots(episode: &FilmEpisode, speed: f64) -> Vec<Shot<'_>> {
    let (title, steps) = (&episode.title, episode.moving());
    let (Some(first), Some(last)) = (steps.first(), steps.last()) else { return Vec::new() };
    let interval_s = f64::from(FRAME_CS) / 100.0 * speed;
    let start_s = first.scene.time_s;
    let mut shots = Vec::new();
    let mut n_frames = 0_u32;
    for pair in steps.windows(2) {
        let [before, after] = pair else { continue };
        let length_s = after.scene.time_s - before.scene.time_s;
        loop {
            let time_s = start_s + f64::from(n_frames) * interval_s;
            let share = (time_s - before.scene.time_s) / length_s;
            // The first share of a step may be below 0 by rounding.
            if length_s.is_nan() || length_s <= 0.0 || share > 1.0 - 1e-6 {
                break;
            }
            let delay_cs = if n_frames == 0 { FIRST_CS } else { FRAME_CS };
            let share = share.max(0.0) as f32;
            shots.push(Shot { title, before, after, share, is_last: false, delay_cs });
            n_frames += 1;
        }
    }
    let (before, after) = (last, last);
    shots.push(Shot { title, before, after, share: 0.0, is_last: true, delay_cs: LAST_CS });
    shots
}

/// Divides frames into groups in which nothing moves visibly since the first of the group.
fn still_groups<'a, 'b>(shots: &'a [Shot<'b>], film: &Film) -> Vec<&'a [Shot<'b>]> {
    let mut groups = Vec::new();
    let mut rest = shots;
    while let Some(first) = rest.first() {
        let first = first.step();
        let view = View::of(&first.scene, film.width, film.height);
        let is_still = |shot: &&Shot<'_>| {
            let step = shot.step();
            let motion_px =
                f64::from(motion_m(&first.scene, &step.scene)) * view.pixels_per_m([0.0; 3]);
            let is_same = step.achieved == first.achieved && step.scene.goals == first.scene.goals;
            is_same && motion_px < STILL_PX
        };
        let n_still = rest.iter().take(MAX_STILL).take_while(is_still).count();
        let (group, after) = rest.split_at(n_still.max(1));
        groups.push(group);
        rest = after;
    }
    groups
}

/// Draws the frames of a group: the bodies of the first, and the captions of each.
fn draw_group(group: &[Shot<'_>], film: &Film, palette: &Palette) -> Vec<Vec<u8>> {
    let Some(first) = group.first() else { return Vec::new() };
    let bodies = draw_bodies(&first.step(), (film.width, film.height));
    let frames = group.iter().map(|shot| {
        let mut raster = bodies.clone();
        write_captions(&mut raster, shot.title, &shot.step(), shot.is_last);
        palette.indices(&raster)
    });
    frames.collect()
}

impl Shot<'_> {
    fn draw(&self, film: &Film) -> Raster {
        draw_step(self.title, &self.step(), self.is_last, (film.width, film.height))
    }

    fn step(&self) -> FilmStep {
        let scene = between(&self.before.scene, &self.after.scene, self.share);
        // Whether a goal is achieved is known at control steps.
        FilmStep { scene, achieved: self.before.achieved.clone() }
    }
}

/// Draws a moment with its captions. `size` is width and height, pixels.
pub(crate) fn draw_step(
    title: &str,
    step: &FilmStep,
    is_last: bool,
    size: (usize, usize),
) -> Raster {
    let mut raster = draw_bodies(step, size);
    write_captions(&mut raster, title, step, is_last);
    raster
}

fn draw_bodies(step: &FilmStep, size: (usize, usize)) -> Raster {
    render_achieved(&step.scene, &step.achieved, size.0, size.1)
}

fn write_captions(raster: &mut Raster, title: &str, step: &FilmStep, is_last: bool) {
    let is_success = !step.achieved.is_empty() && step.achieved.iter().all(|achieved| *achieved);
    let time = format!("{:.2} s", step.scene.time_s);
    let (result, color) = match (is_success, is_last) {
        (true, _) => ("success", GOOD),
        (false, true) => ("failure", BAD),
        (false, false) => ("", INK),
    };
    let title = caption::beside(raster, title, time.chars().count());
    caption::write(raster, (Corner::Left, 0), &title, INK);
    caption::write(raster, (Corner::Right, 0), &time, INK);
    caption::write(raster, (Corner::Right, 1), result, color);
}

/// Returns the smallest frame that changes the picture from `shown` to `indices`, both of shape `[height, width]`.
fn changed_part(shown: Option<&[u8]>, indices: &[u8], width: usize) -> Frame<'static> {
    let height = indices.len() / width;
    let Some(shown) = shown else {
        return frame((0, 0), (width, height), indices.to_vec());
    };
    let changed = |x: usize, y: usize| indices[y * width + x] != shown[y * width + x];
    let rows: Vec<usize> = (0..height).filter(|y| (0..width).any(|x| changed(x, *y))).collect();
    let (Some(top), Some(bottom)) = (rows.first().copied(), rows.last().copied()) else {
        return frame((0, 0), (1, 1), vec![UNCHANGED]);
    };
    let columns = || (0..width).filter(|x| (top..=bottom).any(|y| changed(*x, y)));
    let (left, right) = (columns().next().unwrap_or(0), columns().next_back().unwrap_or(width - 1));
    let pixel = |x: usize, y: usize| match changed(x, y) {
        true => indices[y * width + x],
        false => UNCHANGED,
    };
    let part = (top..=bottom).flat_map(|y| (left..=right).map(move |x| (x, y)));
    let part = part.map(|(x, y)| pixel(x, y)).collect();
    frame((left, top), (right + 1 - left, bottom + 1 - top), part)
}

fn frame(corner: (usize, usize), size: (usize, usize), indices: Vec<u8>) -> Frame<'static> {
    Frame {
        left: to_u16(corner.0),
        top: to_u16(corner.1),
        width: to_u16(size.0),
        height: to_u16(size.1),
        dispose: DisposalMethod::Keep,
        transparent: Some(UNCHANGED),
        buffer: indices.into(),
        ..Frame::default()
    }
}

/// Converts a length in pixels, at most that of [`SIZES_PX`].
fn to_u16(pixels: usize) -> u16 {
    u16::try_from(pixels).unwrap_or(u16::MAX)
}
