//! Pictures and films of simulated scenes, computed by casting rays: the table, arms, objects and goals in perspective,
//! with shadows.
//!
//! Scenes are those of [`tandem_core::scene`]. [`render`] returns the pixels of one scene, and a [`View`] where its
//! points are in them. [`film_gif`], [`film_strip`] and [`picture_png`] return files: an animation of episodes, eight
//! pictures of an episode side by side, and a single picture. The same scenes give the same bytes, on any number of
//! threads.
#![warn(missing_docs)]

mod camera;
#[cfg(feature = "files")]
mod caption;
#[cfg(feature = "files")]
mod error;
#[cfg(feature = "files")]
mod film;
mod interpolate;
#[cfg(feature = "files")]
mod motion;
mod painter;
#[cfg(feature = "files")]
mod palette;
mod raster;
mod shape;
#[cfg(feature = "files")]
mod strip;
mod tiles;

#[cfg(all(test, feature = "files"))]
mod tests;

pub use camera::View;
#[cfg(feature = "files")]
pub use error::Error;
#[cfg(feature = "files")]
pub use film::{Film, FilmEpisode, FilmStep, film_gif, film_gif_with};
pub use interpolate::between;
pub use painter::render;
pub use raster::Raster;
#[cfg(feature = "files")]
pub use strip::{STRIP_PICTURES, film_strip, picture_png};
