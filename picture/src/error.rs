//! Errors of films and pictures.

/// An error while making a picture or a film.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// There is nothing to show.
    #[error("a film needs at least one scene")]
    NoScenes,
    /// Width or height is out of range.
    #[error("pictures of {width}x{height} pixels: expected 64 to 4096 each")]
    Size {
        /// Width, pixels.
        width: usize,
        /// Height, pixels.
        height: usize,
    },
    /// The film would be slower or faster than its frames allow.
    #[error("a speed of {0}: expected 0.05 to 20")]
    Speed(f64),
    /// The encoder of GIF files failed.
    #[error("cannot encode the film")]
    Gif(#[from] gif::EncodingError),
    /// The encoder of PNG files failed.
    #[error("cannot encode the picture")]
    Png(#[from] png::EncodingError),
}
