//! Elements of HTML pages.

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
    format!("<h2>{}</h2>{}", escaped(&titled.title), table(&header, &titled.rows))
}

/// Returns a table that scrolls if it is wider than the page.
pub(crate) fn table(header: &[&str], rows: &[Vec<String>]) -> String {
    let row = |tag: &str, cells: &mut dyn Iterator<Item = &str>| {
        let cells: String = cells.map(|cell| format!("<{tag}>{}</{tag}>", escaped(cell))).collect();
        format!("<tr>{cells}</tr>")
    };
    let body: String =
        rows.iter().map(|cells| row("td", &mut cells.iter().map(String::as_str))).collect();
    format!(
        "<div class=scroll><table><thead>{}</thead><tbody>{body}</tbody></table></div>",
        row("th", &mut header.iter().copied())
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
