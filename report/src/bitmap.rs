//! Plots as PNG, for documents and slides that do not accept SVG.

use resvg::tiny_skia::{Pixmap, Transform};
use resvg::usvg::{Options, Tree};

use crate::error::Error;

/// Pixels of a PNG along an edge of one pixel of the SVG, for screens of high resolution.
const SCALE: f32 = 2.0;

/// Converts SVG to PNG. All text has the same font, which is part of the program, so the bytes do not depend on the
/// machine's fonts.
pub(crate) struct Converter {
    options: Options<'static>,
}

impl Converter {
    pub(crate) fn new() -> Self {
        let mut options = Options::default();
        let fonts = options.fontdb_mut();
        fonts.load_font_data(ttf_noto_sans::REGULAR.to_vec());
        fonts.set_sans_serif_family("Noto Sans");
        Self { options }
    }

    /// Returns the picture `svg`, entitled `title`, as PNG.
    ///
    /// # Errors
    /// If the picture is not valid SVG, or too large.
    pub(crate) fn png(&self, svg: &str, title: &str) -> Result<Vec<u8>, Error> {
        let failed = |problem: String| Error::Draw { title: title.to_owned(), problem };
        let tree = Tree::from_str(svg, &self.options).map_err(|error| failed(error.to_string()))?;
        let scaled = tree.size().scale_by(SCALE).map(|size| size.to_int_size());
        let pixmap = scaled.and_then(|size| Pixmap::new(size.width(), size.height()));
        let mut pixmap = pixmap.ok_or_else(|| failed("it is too large for a PNG".to_owned()))?;
        let transform = Transform::from_scale(SCALE, SCALE);
        resvg::render(&tree, transform, &mut pixmap.as_mut());
        pixmap.encode_png().map_err(|error| failed(error.to_string()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns a picture 20 pixels wide and high, with `content`.
    fn png_of(content: &str) -> Vec<u8> {
        let svg = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"20\" height=\"20\">{content}</svg>"
        );
        Converter::new().png(&svg, "a test").expect("valid SVG")
    }

    #[test]
    fn a_picture_has_twice_the_size_and_the_colours_of_the_svg() {
        let png = png_of("<rect width=\"10\" height=\"20\" fill=\"#ff0000\"/>");
        let pixmap = Pixmap::decode_png(&png).expect("a PNG");
        assert_eq!((pixmap.width(), pixmap.height()), (40, 40));
        let alphas = [19, 20].map(|x| pixmap.pixel(x, 30).expect("within it").alpha());
        assert_eq!(alphas, [255, 0]);
        assert_eq!(pixmap.pixel(0, 0).expect("within it").red(), 255);
    }

    #[test]
    fn text_is_drawn_in_the_fonts_of_plots() {
        let text =
            |font: &str| format!("<text y=\"16\" font-size=\"16\" font-family=\"{font}\">M</text>");
        let drawn = png_of(&text(crate::curve::FONT));
        assert_ne!(drawn, png_of(""));
        assert_eq!(drawn, png_of(&text("sans-serif")));
    }

    #[test]
    fn what_is_not_svg_is_refused_with_the_title() {
        let error = Converter::new().png("<svg", "success of push").expect_err("cut off");
        assert!(error.to_string().contains("success of push"), "{error}");
    }
}
