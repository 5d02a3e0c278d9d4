//! Tokens, and the addresses on which a service requires one.

use std::fmt;
use std::fs::File;
use std::io::Read as _;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};

/// The minimum length of a token, in characters.
const MIN_CHARS: usize = 16;
/// The maximum length of a token, in characters: every call carries it in a header.
const MAX_CHARS: usize = 1024;
/// The maximum size of a token file, in bytes, including surrounding whitespace.
const MAX_FILE_BYTES: u64 = 64 << 10;
/// The prefix of the token in the header, case-insensitive.
const SCHEME: &str = "Bearer ";

/// The secret that callers send as `authorization: Bearer TOKEN`. `Debug` does not print it.
#[derive(Clone, PartialEq, Eq)]
pub struct Token(String);

/// An error in the text of a token.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum TokenError {
    /// The text is empty.
    #[error("it is empty")]
    Empty,
    /// The text is too short to be secure, or too long for a header.
    #[error("it has {0} characters, a token has {MIN_CHARS} to {MAX_CHARS}")]
    Length(usize),
    /// A header cannot contain a character of the text. The position is in bytes, from 1.
    #[error("byte {0} of it is a blank, a control character or not ASCII")]
    Character(usize),
}

/// An error in a service's access configuration.
#[derive(Debug, thiserror::Error)]
pub enum AccessError {
    /// A token or certificate cannot be read.
    #[error("cannot read {path:?}")]
    Read {
        /// The file.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// The content of a file is not a token.
    #[error("{path:?} does not hold a token")]
    Token {
        /// The file.
        path: PathBuf,
        /// The cause.
        source: TokenError,
    },
    /// Other machines can reach the address, and no token protects the service.
    #[error(
        "{0} can be reached from other machines: give --token-file FILE (and --tls-cert, --tls-key), or --insecure to do without"
    )]
    Unprotected(SocketAddr),
}

impl Token {
    /// Parses a token.
    ///
    /// # Errors
    /// When the text has an invalid length or character.
    pub fn new(text: &str) -> Result<Self, TokenError> {
        if text.is_empty() {
            return Err(TokenError::Empty);
        }
        if let Some(idx) = text.bytes().position(|byte| !byte.is_ascii_graphic()) {
            return Err(TokenError::Character(idx + 1));
        }
        if !(MIN_CHARS..=MAX_CHARS).contains(&text.len()) {
            return Err(TokenError::Length(text.len()));
        }
        Ok(Self(text.to_owned()))
    }

    /// Reads the token in a file, without surrounding whitespace.
    ///
    /// # Errors
    /// When the file cannot be read or does not contain a token.
    pub fn read(path: &Path) -> Result<Self, AccessError> {
        let mut bytes = Vec::new();
        File::open(path)
            .and_then(|file| file.take(MAX_FILE_BYTES).read_to_end(&mut bytes))
            .map_err(|source| AccessError::Read { path: path.to_owned(), source })?;
        // Text that is not UTF-8 is not ASCII and is rejected with the replacement characters.
        Self::new(String::from_utf8_lossy(bytes.trim_ascii()).as_ref())
            .map_err(|source| AccessError::Token { path: path.to_owned(), source })
    }

    /// Returns the value of the `authorization` header.
    #[must_use]
    pub fn header(&self) -> String {
        format!("{SCHEME}{}", self.0)
    }

    /// Returns whether `header` carries this token, in a time that does not depend on where it differs.
    #[must_use]
    pub fn matches(&self, header: &[u8]) -> bool {
        let Some((scheme, token)) = header.split_at_checked(SCHEME.len()) else { return false };
        let differences = self.0.bytes().zip(token).fold(0, |sum, (a, b)| sum | (a ^ b));
        scheme.eq_ignore_ascii_case(SCHEME.as_bytes())
            && self.0.len() == token.len()
            && std::hint::black_box(differences) == 0
    }
}

impl fmt::Debug for Token {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str("Token(..)")
    }
}

/// Returns whether other machines can reach a service that listens on `address`.
#[must_use]
pub fn is_exposed(address: SocketAddr) -> bool {
    !address.ip().to_canonical().is_loopback()
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECRET: &str = "0123456789abcdef";

    #[test]
    fn a_token_with_an_invalid_length_or_character_is_rejected() {
        let check = |text: &str, expected| {
            assert_eq!(Token::new(text).map(|_| ()), Err(expected), "{text:?}");
        };
        check("", TokenError::Empty);
        check("0123456789abcde", TokenError::Length(15));
        check(&"x".repeat(1025), TokenError::Length(1025));
        check("0123456789abcdef\0", TokenError::Character(17));
        check("0123456789 abcdef", TokenError::Character(11));
        check("0123456789abcdé", TokenError::Character(15));
        for fits in [SECRET, &"x".repeat(1024), "+/=~!\"#$%&'()*,-"] {
            assert!(Token::new(fits).is_ok(), "{fits}");
        }
    }

    #[test]
    fn whitespace_around_the_token_in_a_file_is_ignored() {
        let directory = tempfile::tempdir().expect("a directory");
        let path = directory.path().join("token");
        let read = |bytes: &[u8]| {
            std::fs::write(&path, bytes).expect("writes");
            Token::read(&path)
        };
        let token = Token::new(SECRET).expect("a token");
        assert_eq!(read(b" \t\r\n0123456789abcdef \r\n\n").expect("a token"), token);
        for refused in [&b""[..], b" \n", b"short", b"\xff\xfe0123456789abcdef", &[b' '; 70_000]] {
            let error = read(refused).expect_err("no token");
            assert!(matches!(error, AccessError::Token { .. }), "{error:?}");
        }
        let missing = Token::read(&directory.path().join("none")).expect_err("no file");
        assert!(matches!(missing, AccessError::Read { .. }), "{missing:?}");
    }

    #[test]
    fn only_the_whole_token_matches() {
        let token = Token::new(SECRET).expect("a token");
        let check = |header: &str, expected| {
            assert_eq!(token.matches(header.as_bytes()), expected, "{header:?}");
        };
        check("Bearer 0123456789abcdef", true);
        check("bearer 0123456789abcdef", true);
        check("Bearer 0123456789abcde", false);
        check("Bearer 0123456789abcdef0", false);
        check("Bearer 0123456789abcdeF", false);
        check("Basic  0123456789abcdef", false);
        check("0123456789abcdef", false);
        check("Bearer ", false);
        check("", false);
    }

    #[test]
    fn debug_output_does_not_contain_the_token() {
        let token = Token::new(SECRET).expect("a token");
        assert!(!format!("{token:?}").contains("0123"));
    }

    #[test]
    fn all_addresses_but_loopback_are_exposed() {
        for (address, exposed) in [
            ("127.0.0.1:0", false),
            ("127.8.8.8:7000", false),
            ("[::1]:7000", false),
            ("[::ffff:127.0.0.1]:7000", false),
            ("0.0.0.0:7000", true),
            ("[::]:7000", true),
            ("[::ffff:0.0.0.0]:7000", true),
            ("[::ffff:10.0.0.1]:7000", true),
            ("[::127.0.0.1]:7000", true),
            ("192.168.1.2:7000", true),
            ("[fe80::1]:7000", true),
        ] {
            assert_eq!(is_exposed(address.parse().expect("an address")), exposed, "{address}");
        }
    }
}
