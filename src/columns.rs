//! Text that fits a terminal.

/// Columns of the narrowest terminal that output is laid out for.
pub(crate) const N_COLUMNS: usize = 80;

/// Breaks `text` between words into lines of at most [`N_COLUMNS`] columns. Lines after the first start with `indent`. A
/// word that is longer than a line, such as a path, gets a line of its own.
pub(crate) fn wrapped(text: &str, indent: &str) -> String {
    let mut lines = vec![String::new()];
    for word in text.split_whitespace() {
        let line = lines.last_mut().expect("there is a line");
        if line.trim().is_empty() {
            line.push_str(word);
        } else if line.chars().count() + 1 + word.chars().count() <= N_COLUMNS {
            line.push(' ');
            line.push_str(word);
        } else {
            lines.push(format!("{indent}{word}"));
        }
    }
    lines.join("\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_break_between_words_only() {
        let path = "x".repeat(100);
        let text = format!("{} {path} end", "word ".repeat(20));
        let lines = wrapped(&text, "  ");
        let lines: Vec<&str> = lines.lines().collect();
        assert_eq!((lines.len(), lines[0].len()), (4, 79), "{lines:?}");
        assert_eq!(lines[1..], ["  word word word word", &format!("  {path}"), "  end"]);
    }
}
