//! Commands that the program prints for a shell.

use std::path::Path;

/// Returns a path as a word of a shell's command line.
pub(crate) fn shell_word(path: &Path) -> String {
    shell_text(path.display().to_string())
}

/// Returns a text as a word of a shell's command line.
pub(crate) fn shell_text(text: String) -> String {
    let is_plain = |c: char| c.is_alphanumeric() || "/._-+:,=@%".contains(c);
    match !text.is_empty() && text.chars().all(is_plain) {
        true => text,
        false => format!("'{}'", text.replace('\'', r"'\''")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn paths_that_a_shell_would_split_are_quoted() {
        for (path, expected) in [
            ("runs/push-2_mc-q:0.1", "runs/push-2_mc-q:0.1"),
            ("my runs/a", "'my runs/a'"),
            ("it's", r"'it'\''s'"),
            ("", "''"),
        ] {
            assert_eq!(shell_word(Path::new(path)), expected);
        }
    }
}
