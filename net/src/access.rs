//! Secrets and where a service may listen.

use std::fmt;
use std::fs::File;
use std::io::Read as _;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};

/// Fewest characters of a token.
const MIN_CHARS: usize = 16;
/// Most characters of a token: it travels in a header of every call.
const MAX_CHARS: usize = 1024;
/// Bytes of a token file that are read; blanks round the token included.
const MAX_FILE_BYTES: u64 = 64 << 10;
/// What stands before the token in the header, in any case.
const SCHEME: &str = "Bearer ";

/// What a caller must show: `authorization: Bearer TOKEN`. Never printed.
#[derive(Clone, PartialEq, Eq)]
pub struct Token(String);

/// Why a text is no token.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum TokenRefused {
    /// There is nothing.
    #[error("it is empty")]
    Empty,
    /// Too easily guessed, or too long for a header.
    #[error("it has {0} characters, a token has {MIN_CHARS} to {MAX_CHARS}")]
    Length(usize),
    /// A header cannot hold it.
    #[error("byte {0} of it is a blank, a control character or not ASCII")]
    Character(usize),
}

/// Why a service may not be offered, or a secret not be used.
#[derive(Debug, thiserror::Error)]
pub enum AccessError {
    /// A secret or certificate cannot be read.
    #[error("cannot read {path:?}")]
    Read {
        /// The file.
        path: PathBuf,
        /// Why not.
        source: std::io::Error,
    },
    /// A file does not hold a token.
    #[error("{path:?} does not hold a token")]
    Token {
        /// The file.
        path: PathBuf,
        /// Why not.
        source: TokenRefused,
    },
    /// The address can be reached from other machines and nothing protects the service.
    #[error(
        "{0} can be reached from other machines: give --token-file FILE (and --tls-cert, --tls-key), or --insecure to do without"
    )]
    Unprotected(SocketAddr),
}

impl Token {
    /// A token from its text.
    ///
    /// # Errors
    /// When the text is short or long, or holds what a header cannot.
    pub fn new(text: &str) -> Result<Self, TokenRefused> {
        if text.is_empty() {
            return Err(TokenRefused::Empty);
        }
        if let Some(idx) = text.bytes().position(|byte| !byte.is_ascii_graphic()) {
            return Err(TokenRefused::Character(idx + 1));
        }
        if !(MIN_CHARS..=MAX_CHARS).contains(&text.len()) {
            return Err(TokenRefused::Length(text.len()));
        }
        Ok(Self(text.to_owned()))
    }

    /// The token in a file; blanks round it do not count.
    ///
    /// # Errors
    /// When the file cannot be read or holds no token.
    pub fn read(path: &Path) -> Result<Self, AccessError> {
        let mut bytes = Vec::new();
        File::open(path)
            .and_then(|file| file.take(MAX_FILE_BYTES).read_to_end(&mut bytes))
            .map_err(|source| AccessError::Read { path: path.to_owned(), source })?;
        // What is not UTF-8 is not ASCII either, and no token.
        Self::new(String::from_utf8_lossy(bytes.trim_ascii()).as_ref())
            .map_err(|source| AccessError::Token { path: path.to_owned(), source })
    }

    /// The header's value.
    pub(crate) fn header(&self) -> String {
        format!("{SCHEME}{}", self.0)
    }

    /// Whether `header` shows this token, in a time that does not tell how much of it was right.
    pub(crate) fn is_shown_by(&self, header: &[u8]) -> bool {
        let Some((scheme, shown)) = header.split_at_checked(SCHEME.len()) else { return false };
        let differences = self.0.bytes().zip(shown).fold(0, |sum, (a, b)| sum | (a ^ b));
        scheme.eq_ignore_ascii_case(SCHEME.as_bytes())
            && self.0.len() == shown.len()
            && std::hint::black_box(differences) == 0
    }
}

impl fmt::Debug for Token {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str("Token(..)")
    }
}

/// Whether other machines can reach a service that listens on `address`.
#[must_use]
pub fn is_exposed(address: SocketAddr) -> bool {
    !address.ip().to_canonical().is_loopback()
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECRET: &str = "0123456789abcdef";

    #[test]
    fn what_a_header_cannot_hold_or_anybody_could_guess_is_no_token() {
        let check = |text: &str, expected| {
            assert_eq!(Token::new(text).map(|_| ()), Err(expected), "{text:?}");
        };
        check("", TokenRefused::Empty);
        check("0123456789abcde", TokenRefused::Length(15));
        check(&"x".repeat(1025), TokenRefused::Length(1025));
        check("0123456789abcdef\0", TokenRefused::Character(17));
        check("0123456789 abcdef", TokenRefused::Character(11));
        check("0123456789abcdé", TokenRefused::Character(15));
        for fits in [SECRET, &"x".repeat(1024), "+/=~!\"#$%&'()*,-"] {
            assert!(Token::new(fits).is_ok(), "{fits}");
        }
    }

    #[test]
    fn a_file_holds_a_token_between_blanks() {
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
    fn a_token_is_shown_whole_or_not_at_all() {
        let token = Token::new(SECRET).expect("a token");
        let check = |header: &str, shown| {
            assert_eq!(token.is_shown_by(header.as_bytes()), shown, "{header:?}");
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
    fn a_token_is_not_printed() {
        let token = Token::new(SECRET).expect("a token");
        assert!(!format!("{token:?}").contains("0123"));
    }

    #[test]
    fn only_loopback_addresses_are_out_of_reach() {
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
