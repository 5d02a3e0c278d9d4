//! The layout of titles and legends: estimated widths, and lines that fit.

/// Size of the text of a legend, pixels.
pub(crate) const LEGEND_PX: u32 = 13;
/// Left edge of the title and the legend, pixels.
pub(crate) const LEGEND_LEFT_PX: i32 = 20;
/// Height of a legend line, pixels.
pub(crate) const LEGEND_LINE_PX: i32 = 20;
/// Width of a marker in the legend, with the gap to its name, pixels.
const MARKER_PX: i32 = 22;
/// Gap between two entries of a legend line, pixels.
const ENTRY_GAP_PX: i32 = 20;

/// An entry of a legend: a marker, 22 pixels wide, and a name.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct LegendEntry {
    /// The name, on as many lines as it needs.
    pub(crate) name: Vec<String>,
    /// Left edge, pixels.
    pub(crate) left: i32,
    /// First legend line, from 0.
    pub(crate) line: i32,
}

impl LegendEntry {
    /// Returns the number of legend lines.
    pub(crate) fn n_lines(&self) -> i32 {
        i32::try_from(self.name.len()).unwrap_or(i32::MAX / 64).max(1)
    }
}

/// Lays out the entries of a legend that is `width_px` pixels wide.
pub(crate) fn legend_entries<'a>(
    names: impl Iterator<Item = &'a str>,
    width_px: u32,
) -> Vec<LegendEntry> {
    let width_px = i32::try_from(width_px).unwrap_or(i32::MAX);
    let (mut left, mut line, mut next_line) = (LEGEND_LEFT_PX, 0, 1);
    let entry = |name| {
        let name = wrapped(name, LEGEND_PX, width_px - LEGEND_LEFT_PX - MARKER_PX);
        let name_px = name.iter().map(|line| estimated_width_px(line, LEGEND_PX)).max();
        let entry_px = MARKER_PX + name_px.unwrap_or(0);
        if left > LEGEND_LEFT_PX && left + entry_px > width_px {
            (left, line) = (LEGEND_LEFT_PX, next_line);
        }
        let entry = LegendEntry { name, left, line };
        next_line = next_line.max(line + entry.n_lines());
        left += entry_px + ENTRY_GAP_PX;
        entry
    };
    names.map(entry).collect()
}

/// Returns the number of lines of a legend.
pub(crate) fn n_legend_lines(entries: &[LegendEntry]) -> i32 {
    entries.iter().map(|entry| entry.line + entry.n_lines()).max().unwrap_or(0)
}

/// Breaks `text` into lines of at most `room_px` pixels. A word that is too long has a line of its own.
pub(crate) fn wrapped(text: &str, size_px: u32, room_px: i32) -> Vec<String> {
    let mut lines: Vec<String> = Vec::new();
    for word in text.split_whitespace() {
        match lines.last_mut() {
            Some(line) if estimated_width_px(&format!("{line} {word}"), size_px) <= room_px => {
                line.push(' ');
                line.push_str(word);
            }
            _ => lines.push(word.to_owned()),
        }
    }
    lines
}

/// Estimates the width of `text` in a sans-serif font. The viewer chooses the font, so the exact width is unknown.
pub(crate) fn estimated_width_px(text: &str, size_px: u32) -> i32 {
    let n_chars = u32::try_from(text.chars().count()).unwrap_or(u32::MAX);
    i32::try_from(n_chars.saturating_mul(size_px) / 2).unwrap_or(i32::MAX / 2)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_legend_has_as_many_lines_as_its_names_need() {
        let positions = |names: &[&str]| {
            let entries = legend_entries(names.iter().copied(), 300);
            let at = entries.iter().map(|entry| (entry.left, entry.line)).collect::<Vec<_>>();
            (at, n_legend_lines(&entries))
        };
        assert_eq!(positions(&[]), (vec![], 0));
        let long = "0123456789";
        assert_eq!(positions(&[long, long, long]), (vec![(20, 0), (127, 0), (20, 1)], 2));
        let longest = long.repeat(6);
        assert_eq!(positions(&[&longest, long]), (vec![(20, 0), (20, 1)], 2));
        let words = [long; 6].join(" ");
        assert_eq!(positions(&[&words, long]), (vec![(20, 0), (20, 2)], 3), "two lines, then one");
    }

    #[test]
    fn a_long_text_is_wrapped_without_losing_words() {
        let text = "word ".repeat(100);
        let lines = wrapped(&text, 13, 720);
        assert!(lines.len() > 1);
        assert!(lines.iter().all(|line| estimated_width_px(line, 13) <= 720), "{lines:?}");
        assert_eq!(lines.join(" "), text.trim());
        assert_eq!(wrapped(&"x".repeat(500), 13, 720).len(), 1);
        assert_eq!(wrapped("", 13, 720), [""; 0]);
    }
}
