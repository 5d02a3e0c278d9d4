//! Tokens and certificates from the files that the command line names.

use std::path::Path;

use tandem_net::{AccessError, ClientConfig, ServerConfig, Token, is_exposed};
use tracing::warn;

use crate::cli::{ClientArgs, ListenArgs, SecretArgs};
use crate::exit::{Exit, Failed, OrExit as _};
use crate::input;

/// Returns the access rules of a service; rejects an unprotected address that other machines can reach.
pub(crate) fn server_config(
    listen: &ListenArgs,
    secret: &SecretArgs,
) -> Result<ServerConfig, Failed> {
    let mut server_config = ServerConfig::default();
    if let Some(token) = token(secret)? {
        server_config = server_config.with_token(token);
    }
    if let (Some(certificate), Some(key)) = (&listen.tls_cert, &listen.tls_key) {
        let what = || format!("cannot serve with --tls-cert {certificate:?} --tls-key {key:?}");
        server_config = server_config
            .with_certificate(&read(certificate)?, &read(key)?)
            .or_exit(Exit::Usage, what)?;
    }
    if !listen.insecure {
        server_config.check_address(listen.listen).or_exit(Exit::Usage, String::new)?;
    }
    if is_exposed(listen.listen) && secret.token_file.is_some() && server_config.is_plain() {
        let address = listen.listen;
        warn!(%address, "without --tls-cert, others on the network can read all messages and the token");
    }
    Ok(server_config)
}

/// Returns how to call other services.
pub(crate) fn client_config(
    args: &ClientArgs,
    secret: &SecretArgs,
) -> Result<ClientConfig, Failed> {
    let calls = client_config_without_token(args)?;
    Ok(match token(secret)? {
        Some(token) => calls.with_token(&token),
        None => calls,
    })
}

/// Returns how to call services that require no token.
pub(crate) fn client_config_without_token(args: &ClientArgs) -> Result<ClientConfig, Failed> {
    let Some(authority) = &args.tls_ca else { return Ok(ClientConfig::default()) };
    let what = || format!("cannot trust --tls-ca {authority:?}");
    ClientConfig::default().with_authority(&read(authority)?).or_exit(Exit::Usage, what)
}

fn token(secret: &SecretArgs) -> Result<Option<Token>, Failed> {
    secret.token_file.as_deref().map(read_token).transpose()
}

/// Reads the token in a file.
pub(crate) fn read_token(path: &Path) -> Result<Token, Failed> {
    let (name, cannot_read) = (path.to_owned(), || format!("cannot read {path:?}"));
    let read =
        input::in_time(path, move || Token::read(&name)).or_exit(Exit::Usage, cannot_read)?;
    let token = read.or_exit(Exit::Usage, String::new)?;
    if is_readable_by_all(path) {
        warn!(?path, "every user of this machine can read the token: chmod 600 FILE");
    }
    Ok(token)
}

/// Returns true if the mode of the file lets all users read it.
#[cfg(unix)]
fn is_readable_by_all(path: &Path) -> bool {
    use std::os::unix::fs::PermissionsExt as _;
    std::fs::metadata(path).is_ok_and(|file| file.permissions().mode() & 0o004 != 0)
}

#[cfg(not(unix))]
const fn is_readable_by_all(_: &Path) -> bool {
    false
}

fn read(path: &Path) -> Result<Vec<u8>, Failed> {
    input::bytes(path)
        .map_err(|source| AccessError::Read { path: path.to_owned(), source })
        .or_exit(Exit::Usage, String::new)
}
