//! Commands that the program prints for a shell.

use std::os::unix::ffi::OsStrExt as _;
use std::path::Path;

/// Returns a path as a word of a shell's command line.
pub(crate) fn shell_word(path: &Path) -> String {
    match path.to_str() {
        Some(text) => shell_text(text.to_owned()),
        None => byte_word(path.as_os_str().as_bytes()),
    }
}

/// Returns bytes that are not UTF-8 as a word for bash, zsh and other shells that know `$'…'`.
fn byte_word(bytes: &[u8]) -> String {
    let character = |byte: &u8| match byte {
        b'\'' | b'\\' => format!("\\{}", char::from(*byte)),
        b' '..=b'~' => char::from(*byte).to_string(),
        byte => format!("\\x{byte:02x}"),
    };
    format!("$'{}'", bytes.iter().map(character).collect::<String>())
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
    use std::ffi::OsStr;
    use std::process::Command;

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

    #[test]
    fn a_shell_gets_the_bytes_of_any_path() {
        let path = Path::new(OsStr::from_bytes(b"a\xffb'c\\ \n1"));
        let word = shell_word(path);
        assert_eq!(word, r"$'a\xffb\'c\\ \x0a1'");
        let printed = Command::new("bash").args(["-c", &format!("printf %s {word}")]).output();
        assert_eq!(printed.expect("bash runs").stdout, path.as_os_str().as_bytes());
    }
}
