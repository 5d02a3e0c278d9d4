//! Text that fits a terminal.

pub(crate) use tandem_report::table::{TERMINAL_COLUMNS as N_COLUMNS, wrapped};

/// Returns the columns of the terminal at standard error; [`N_COLUMNS`] if it reports none.
pub(crate) fn terminal_columns() -> usize {
    let size = rustix::termios::tcgetwinsize(std::io::stderr()).ok();
    size.map(|size| usize::from(size.ws_col)).filter(|n| *n > 0).unwrap_or(N_COLUMNS)
}

/// Returns the beginning of `text` that fits `n_columns` and ends with one of its parts, so that no number is cut. Parts
/// are separated by `, `, `; ` and ` (`. If not even the first one fits, returns the whole text.
pub(crate) fn fitting(text: &str, n_columns: usize) -> &str {
    let fits = |part: &str| part.chars().count() <= n_columns;
    if fits(text) {
        return text;
    }
    let ends = [", ", "; ", " ("].into_iter().flat_map(|end| text.match_indices(end));
    let parts = ends.map(|(end, _)| &text[..end]).filter(|part| fits(part));
    parts.max_by_key(|part| part.len()).unwrap_or(text)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_that_does_not_fit_ends_before_a_part() {
        let text = "00:06 8,000 of 100,000 env steps (1209/s), 400 updates, 01:16 left";
        assert_eq!(fitting(text, 80), text);
        assert_eq!(fitting(text, 60), "00:06 8,000 of 100,000 env steps (1209/s), 400 updates");
        assert_eq!(fitting(text, 40), "00:06 8,000 of 100,000 env steps");
        assert_eq!(fitting(text, 20), text);
        assert_eq!(fitting("best success –; training 0.19", 16), "best success –");
    }
}
