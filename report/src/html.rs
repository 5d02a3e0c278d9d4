//! Elements of HTML pages.

use base64::prelude::{BASE64_STANDARD, Engine as _};

use crate::comparison::FilmStrip;
use crate::curve::Drawing;
use crate::plots::Plot;
use crate::table::Table;

const STYLE: &str = include_str!("report.css");

/// Returns a page that loads nothing from elsewhere. `body` is HTML, `title` is text.
pub(crate) fn page(title: &str, body: &str) -> String {
    let title = escaped(title);
    format!(
        "<!doctype html>\n<html lang=en><head><meta charset=utf-8><meta name=viewport content=\"width=device-width\">\
         <title>{title}</title><style>{STYLE}</style></head><body><main><h1>{title}</h1>{body}</main></body></html>\n"
    )
}

/// Returns a table below its title.
pub(crate) fn titled_table(titled: &Table) -> String {
    let header: Vec<&str> = titled.header.iter().map(String::as_str).collect();
    format!("<h3>{}</h3>{}", escaped(&titled.title), table(&titled.title, &header, &titled.rows))
}

/// Returns a table that scrolls if it is wider than the page, by keyboard too. Ranges and intervals are below their
/// values.
pub(crate) fn table(title: &str, header: &[&str], rows: &[Vec<String>]) -> String {
    let head: String = header.iter().map(|cell| format!("<th>{}</th>", escaped(cell))).collect();
    let row = |cells: &Vec<String>| {
        let cells: String = cells.iter().map(|cell| format!("<td>{}</td>", value(cell))).collect();
        format!("<tr>{cells}</tr>")
    };
    let body: String = rows.iter().map(row).collect();
    let title = escaped(title);
    format!(
        "<div class=scroll tabindex=0 role=region aria-label=\"{title}\"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>"
    )
}

/// Returns the content of a cell, with a range or interval that follows a number on a line of its own.
fn value(cell: &str) -> String {
    let is_number = cell.starts_with(|first: char| first.is_ascii_digit());
    match cell.find(" (").or_else(|| cell.find(" [")).filter(|_| is_number) {
        Some(at) => {
            format!("{}<br><small>{}</small>", escaped(&cell[..at]), escaped(cell[at..].trim()))
        }
        None => escaped(cell),
    }
}

/// Returns content that is folded until the reader opens it.
pub(crate) fn details(summary: &str, content: &str) -> String {
    format!("<details><summary>{}</summary>{content}</details>", escaped(summary))
}

/// Returns a film strip with its title. On a narrow screen two of its pictures are side by side. `idx` distinguishes the
/// strips of a page.
pub(crate) fn film_strip(idx: usize, film: &FilmStrip) -> String {
    let (title, data) = (escaped(&film.title), BASE64_STANDARD.encode(&film.png));
    let source = format!("data:image/png;base64,{data}");
    let strip = match png_size_px(&film.png) {
        Some(size_px) => {
            pictures(&format!("film-{idx}"), &title, &source, (size_px, film.picture_px))
        }
        None => format!("<img alt=\"{title}\" src=\"{source}\">"),
    };
    format!("<figure class=film>{strip}<figcaption>{title}</figcaption></figure>")
}

/// Returns a strip as a whole and picture by picture; both refer to one image `id`, whose size and whose pictures' size
/// are `size_px` and `picture_px`, in pixels.
fn pictures(
    id: &str,
    title: &str,
    source: &str,
    ((width, height), (picture_width, picture_height)): ((usize, usize), (usize, usize)),
) -> String {
    // The strip begins and ends with a picture, so the pictures and gaps after the first fill the rest equally.
    let along = |length: usize, picture: usize| -> Vec<usize> {
        let n = (length / picture.max(1)).max(1);
        let rest = length.saturating_sub(picture);
        (0..n).map(|idx| rest * idx / (n - 1).max(1)).collect()
    };
    let (lefts, tops) = (along(width, picture_width), along(height, picture_height));
    let at = tops.iter().flat_map(|top| lefts.iter().map(move |left| (left, top)));
    let single = |(x, y)| {
        format!(
            "<svg viewBox=\"{x} {y} {picture_width} {picture_height}\"><use href=\"#{id}\"/></svg>"
        )
    };
    let singles: String = at.map(single).collect();
    format!(
        "<svg class=source aria-hidden=true><defs><image id={id} width={width} height={height} href=\"{source}\"/></defs></svg>\
         <svg class=wide role=img aria-label=\"{title}\" viewBox=\"0 0 {width} {height}\"><use href=\"#{id}\"/></svg>\
         <div class=narrow role=img aria-label=\"{title}\">{singles}</div>"
    )
}

/// Returns width and height of a PNG file, pixels; `None` if the file is none.
fn png_size_px(png: &[u8]) -> Option<(usize, usize)> {
    let header = png.strip_prefix(b"\x89PNG\r\n\x1a\n")?.get(4..)?.strip_prefix(b"IHDR")?;
    let (width, rest) = header.split_first_chunk()?;
    let height = rest.first_chunk()?;
    let pixels = |bytes: &[u8; 4]| usize::try_from(u32::from_be_bytes(*bytes)).ok();
    Some((pixels(width)?, pixels(height)?))
}

/// Returns plots side by side.
pub(crate) fn plot_grid(plots: &[Plot]) -> String {
    figure_grid(plots.iter().map(|plot| (plot.svg.as_str(), plot.narrow_svg.as_str())))
}

/// Returns drawings side by side.
pub(crate) fn drawing_grid(drawings: &[Drawing]) -> String {
    figure_grid(drawings.iter().map(|one| (one.wide.as_str(), one.narrow.as_str())))
}

fn figure_grid<'a>(svgs: impl Iterator<Item = (&'a str, &'a str)>) -> String {
    let figure = |(wide, narrow)| {
        format!("<figure><div class=wide>{wide}</div><div class=narrow>{narrow}</div></figure>")
    };
    let figures: String = svgs.map(figure).collect();
    format!("<div class=figures>{figures}</div>")
}

/// Escapes text for HTML and SVG.
pub(crate) fn escaped(text: &str) -> String {
    // XML knows no control characters but these.
    let is_foreign =
        |c: char| (c.is_control() && !"\t\n\r".contains(c)) || matches!(c, '\u{fffe}' | '\u{ffff}');
    let text = text.replace(is_foreign, "\u{fffd}");
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn characters_that_xml_does_not_have_are_replaced() {
        assert_eq!(escaped("<a\u{1b}\u{ffff}\u{fffe}\tü"), "&lt;a\u{fffd}\u{fffd}\u{fffd}\tü");
    }

    #[test]
    fn a_film_strip_has_each_of_its_pictures_once_for_narrow_screens() {
        let mut png = b"\x89PNG\r\n\x1a\n\0\0\0\x0dIHDR".to_vec();
        // Four columns and two rows of 480 by 300 pixels with gaps of 6.
        png.extend([1938_u32, 606].map(u32::to_be_bytes).as_flattened());
        let mut film = FilmStrip {
            title: "a < b".to_owned(),
            file_name: String::new(),
            png,
            picture_px: (480, 300),
        };
        let html = film_strip(3, &film);
        assert_eq!(html.matches("<svg viewBox=").count(), 8, "{html}");
        for part in
            ["\"0 0 480 300\"", "\"486 0 480 300\"", "\"1458 306 480 300\"", "\"0 0 1938 606\""]
        {
            assert_eq!(html.matches(part).count(), 1, "{part} in {html}");
        }
        assert_eq!(html.matches("base64,").count(), 1, "the data is there once");
        assert!(html.contains("id=film-3 ") && html.contains("a &lt; b"));
        film.png.truncate(20);
        assert!(film_strip(3, &film).contains("<img"));
    }

    #[test]
    fn ranges_are_below_their_values() {
        assert_eq!(
            value("0.996 (0.99–1.0) [0.9, 1.0]"),
            "0.996<br><small>(0.99–1.0) [0.9, 1.0]</small>"
        );
        assert_eq!(value("0.958 [0.9, 1.0]"), "0.958<br><small>[0.9, 1.0]</small>");
        assert_eq!(value("mc-q (#2)"), "mc-q (#2)");
        assert_eq!(value("a < b"), "a &lt; b");
    }
}
