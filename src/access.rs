//! Tokens and certificates, from the files that the command line names.

use std::path::Path;

use tandem_net::{AccessError, Dial, Gate, Token};

use crate::cli::{DialArgs, ListenArgs, SecretArgs};
use crate::exit::{Exit, Failed, OrExit as _};

/// Who may call the service; refuses an address that others can reach and nothing protects.
pub(crate) fn gate(listen: &ListenArgs, secret: &SecretArgs) -> Result<Gate, Failed> {
    let mut gate = Gate::default();
    if let Some(token) = token(secret)? {
        gate = gate.with_token(token);
    }
    if let (Some(certificate), Some(key)) = (&listen.tls_cert, &listen.tls_key) {
        gate = gate.with_certificate(&read(certificate)?, &read(key)?);
    }
    if !listen.insecure {
        gate.check_address(listen.listen).or_exit(Exit::Usage, String::new)?;
    }
    Ok(gate)
}

/// How other services are called.
pub(crate) fn dial(dial: &DialArgs, secret: &SecretArgs) -> Result<Dial, Failed> {
    let mut calls = Dial::default();
    if let Some(token) = token(secret)? {
        calls = calls.with_token(&token);
    }
    if let Some(authority) = &dial.tls_ca {
        calls = calls.with_authority(&read(authority)?);
    }
    Ok(calls)
}

fn token(secret: &SecretArgs) -> Result<Option<Token>, Failed> {
    secret.token_file.as_deref().map(Token::read).transpose().or_exit(Exit::Usage, String::new)
}

fn read(path: &Path) -> Result<Vec<u8>, Failed> {
    std::fs::read(path)
        .map_err(|source| AccessError::Read { path: path.to_owned(), source })
        .or_exit(Exit::Usage, String::new)
}
