//! Elements of HTML pages.

use base64::prelude::{BASE64_STANDARD, Engine as _};

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
    format!("<h3>{}</h3>{}", escaped(&titled.title), table(&header, &titled.rows))
}

/// Returns a table that scrolls if it is wider than the page. Ranges and intervals are below their values.
pub(crate) fn table(header: &[&str], rows: &[Vec<String>]) -> String {
    let head: String = header.iter().map(|cell| format!("<th>{}</th>", escaped(cell))).collect();
    let row = |cells: &Vec<String>| {
        let cells: String = cells.iter().map(|cell| format!("<td>{}</td>", value(cell))).collect();
        format!("<tr>{cells}</tr>")
    };
    let body: String = rows.iter().map(row).collect();
    format!(
        "<div class=scroll><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>"
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

/// Returns a film strip with its title. `png` is the content of its file.
pub(crate) fn film_strip(title: &str, png: &[u8]) -> String {
    let (title, data) = (escaped(title), BASE64_STANDARD.encode(png));
    format!(
        "<figure class=film><img alt=\"{title}\" src=\"data:image/png;base64,{data}\"><figcaption>{title}</figcaption></figure>"
    )
}

/// Returns plots side by side.
pub(crate) fn plot_grid(plots: &[Plot]) -> String {
    let svgs: Vec<&str> = plots.iter().map(|plot| plot.svg.as_str()).collect();
    svg_grid(&svgs)
}

/// Returns SVG images side by side.
pub(crate) fn svg_grid(svgs: &[&str]) -> String {
    let figures: String = svgs.iter().map(|svg| format!("<figure>{svg}</figure>")).collect();
    format!("<div class=figures>{figures}</div>")
}

/// Escapes text for HTML and SVG.
pub(crate) fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

#[cfg(test)]
mod tests {
    use super::*;

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
