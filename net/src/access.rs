//! Secrets and where a service may listen.

use std::fmt;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};

/// Fewest characters of a token.
const MIN_CHARS: usize = 16;

/// What a caller must show: `authorization: Bearer TOKEN`. Never printed.
#[derive(Clone, PartialEq, Eq)]
pub struct Token(String);

/// Why a text is no token.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("a token has at least {MIN_CHARS} printable ASCII characters and no blanks")]
pub struct TokenRefused;

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
    /// When the text is short, or holds what a header cannot.
    pub fn new(text: &str) -> Result<Self, TokenRefused> {
        let fits = text.len() >= MIN_CHARS && text.bytes().all(|byte| byte.is_ascii_graphic());
        if fits { Ok(Self(text.to_owned())) } else { Err(TokenRefused) }
    }

    /// The token in a file; blanks round it do not count.
    ///
    /// # Errors
    /// When the file cannot be read or holds no token.
    pub fn read(path: &Path) -> Result<Self, AccessError> {
        let text = std::fs::read_to_string(path)
            .map_err(|source| AccessError::Read { path: path.to_owned(), source })?;
        Self::new(text.trim())
            .map_err(|source| AccessError::Token { path: path.to_owned(), source })
    }

    /// The header's value.
    pub(crate) fn header(&self) -> String {
        format!("Bearer {}", self.0)
    }

    /// Whether `header` shows this token, in a time that does not tell how much of it was right.
    pub(crate) fn is_shown_by(&self, header: &[u8]) -> bool {
        let expected = self.header();
        let differences = expected.bytes().zip(header).fold(0, |sum, (a, b)| sum | (a ^ b));
        expected.len() == header.len() && differences == 0
    }
}

impl fmt::Debug for Token {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str("Token(..)")
    }
}
