//! Texts for messages of one line.

use std::error::Error;
use std::fmt::Write as _;

/// Returns an error and its causes, outermost first.
pub fn causes<'a>(
    error: &'a (dyn Error + 'static),
) -> impl Iterator<Item = &'a (dyn Error + 'static)> + use<'a> {
    std::iter::successors(Some(error), |&error| error.source())
}

/// Joins an error and its causes on one line. A cause that the line already contains is left out.
#[must_use]
pub fn error_chain(error: &(dyn Error + 'static)) -> String {
    let mut line = String::new();
    for cause in causes(error) {
        let text = cause.to_string().replace('\n', " ");
        if !line.contains(&text) {
            let separator = if line.is_empty() { "" } else { ": " };
            line.push_str(separator);
            line.push_str(&text);
        }
    }
    line
}

/// Returns `text`, or its first `max_chars` characters followed by its length.
#[must_use]
pub fn shortened(text: &str, max_chars: usize) -> String {
    match text.char_indices().nth(max_chars) {
        Some((end, _)) => format!("{}... ({} bytes)", &text[..end], text.len()),
        None => text.to_owned(),
    }
}

/// Returns `n` and `noun`, with the plural of regular nouns: `1 arm`, `2 arms`.
#[must_use]
pub fn counted(n: usize, noun: &str) -> String {
    let plural = if n == 1 { "" } else { "s" };
    format!("{n} {noun}{plural}")
}

/// Encodes bytes as lower-case hexadecimal digits, two per byte.
#[must_use]
pub fn hex(bytes: &[u8]) -> String {
    bytes.iter().fold(String::with_capacity(2 * bytes.len()), |mut digits, byte| {
        write!(digits, "{byte:02x}").expect("a string accepts any text");
        digits
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug, thiserror::Error)]
    #[error("{message}")]
    struct Layer {
        message: &'static str,
        source: Option<Box<Self>>,
    }

    fn layers(messages: &[&'static str]) -> Option<Box<Layer>> {
        let (message, inner) = messages.split_first()?;
        Some(Box::new(Layer { message, source: layers(inner) }))
    }

    #[test]
    fn a_cause_that_repeats_the_line_is_left_out() {
        let error = layers(&["cannot read \"x\": gone", "gone", "two\nlines"]).expect("an error");
        assert_eq!(error_chain(&*error), "cannot read \"x\": gone: two lines");
        assert_eq!(error_chain(&*layers(&["alone"]).expect("an error")), "alone");
    }

    #[test]
    fn long_texts_are_cut_between_characters() {
        for (text, expected) in
            [("", ""), ("äöü", "äöü"), ("äöüß", "äöü... (8 bytes)"), ("abcd", "abc... (4 bytes)")]
        {
            assert_eq!(shortened(text, 3), expected);
        }
    }

    #[test]
    fn bytes_become_two_digits_each() {
        assert_eq!(hex(&[0, 9, 0x1f, 0xff]), "00091fff");
        assert_eq!(hex(&[]), "");
    }
}
