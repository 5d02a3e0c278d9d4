//! Dashboards: the addresses on which they listen, and who may see them.

use std::io::{self, ErrorKind};
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::path::Path;

use tandem_dashboard::{Access, Site};
use tandem_net::{Capacity, is_exposed};
use tandem_system::fd_limit;
use tokio::net::TcpListener;
use tokio_util::sync::CancellationToken;

use crate::access;
use crate::cli::DashboardArgs;
use crate::exit::Failed;

/// The first port of dashboards.
const FIRST_PORT: u16 = 8600;
/// Number of ports that are tried if they are in use.
const N_PORTS: u16 = 100;

/// Returns the first address of a dashboard for which none is named.
pub(crate) const fn default_address() -> SocketAddr {
    SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), FIRST_PORT)
}

/// Returns the first address that a dashboard tries, unless there is none.
///
/// # Errors
/// When other machines can reach the address and there is no token, or the token cannot be read.
pub(crate) fn address(args: &DashboardArgs) -> Result<Option<SocketAddr>, Failed> {
    if args.no_dashboard {
        return Ok(None);
    }
    let address = args.dashboard.unwrap_or_else(default_address);
    access("--dashboard", address, args.dashboard_token_file.as_deref(), false)?;
    Ok(Some(address))
}

/// Returns who may see a dashboard on `address`: anyone on this machine, and others with the token in `token_file`.
///
/// # Errors
/// When other machines can reach the address and there is no token, or the token cannot be read.
pub(crate) fn access(
    option: &str,
    address: SocketAddr,
    token_file: Option<&Path>,
    insecure: bool,
) -> Result<Access, Failed> {
    let token = token_file.map(access::read_token).transpose()?;
    match token {
        _ if !is_exposed(address) => Ok(Access::local()),
        Some(token) => Ok(Access::with_token(token)),
        None if insecure => Ok(Access::anyone()),
        None => Err(Failed::usage(format!(
            "{option} {address} can be reached from other machines: give --dashboard-token-file FILE, \
             or keep 127.0.0.1 and forward the port with `ssh -L`"
        ))),
    }
}

/// Binds `address` or, if its port is in use, the next free one.
pub(crate) async fn bind_free(address: SocketAddr) -> io::Result<TcpListener> {
    let mut bound = TcpListener::bind(address).await;
    for offset in 1..N_PORTS {
        let Some(port) = address.port().checked_add(offset) else { break };
        match &bound {
            Err(error) if error.kind() == ErrorKind::AddrInUse => {
                bound = TcpListener::bind(SocketAddr::new(address.ip(), port)).await;
            }
            _ => break,
        }
    }
    bound
}

/// Serves `site` until `shutdown` is cancelled, with as many connections as the limit of open files allows.
pub(crate) async fn serve(
    site: Site,
    access: Access,
    listener: TcpListener,
    shutdown: CancellationToken,
) {
    let capacity = Capacity::of_dashboard(fd_limit::raise());
    tandem_dashboard::serve(site, access, listener, capacity, shutdown).await;
}

/// Returns the address to enter in a browser on this machine.
pub(crate) fn url(address: SocketAddr) -> String {
    match address.ip().is_unspecified() {
        true => format!("http://localhost:{}/", address.port()),
        false => format!("http://{address}/"),
    }
}

/// Returns the port of an [`url`] at the end of a line.
pub(crate) fn port_of(line: &str) -> Option<u16> {
    line.trim_end_matches('/').rsplit_once(':')?.1.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_port_in_use_leads_to_the_next_free_one() {
        let taken = TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let address = taken.local_addr().expect("bound");
        let found = bind_free(address).await.expect("a free port").local_addr().expect("bound");
        assert!(found.port() > address.port() && found.ip() == address.ip(), "{found}");
    }

    #[test]
    fn an_address_that_others_can_reach_needs_a_token() {
        let check = |address: &str, insecure| {
            let address = address.parse().expect("an address");
            access("--dashboard", address, None, insecure).is_ok()
        };
        assert!(check("127.0.0.1:8600", false) && check("[::1]:8600", false));
        assert!(!check("0.0.0.0:8600", false) && check("0.0.0.0:8600", true));
    }

    #[test]
    fn an_address_of_all_interfaces_is_opened_as_localhost() {
        assert_eq!(url("0.0.0.0:8600".parse().expect("an address")), "http://localhost:8600/");
        assert_eq!(url("[::1]:86".parse().expect("an address")), "http://[::1]:86/");
    }

    #[test]
    fn the_port_is_at_the_end_of_the_line_with_the_address() {
        for address in ["127.0.0.1:8600", "0.0.0.0:8601", "[::1]:86"] {
            let address: SocketAddr = address.parse().expect("an address");
            assert_eq!(port_of(&format!("dashboard on {}", url(address))), Some(address.port()));
        }
        assert_eq!(port_of("no dashboard: every port is in use"), None);
    }
}
