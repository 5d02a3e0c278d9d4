//! The address of a service.

use std::io::ErrorKind;
use std::net::SocketAddr;

use tandem_net::{Capacity, Incoming};
use tandem_system::fd_limit;
use tokio::net::TcpListener;

use crate::cli::ListenArgs;
use crate::exit::{Exit, Failed};
use crate::output;

/// A bound address that is not announced yet.
pub(crate) struct Bound {
    incoming: Incoming,
    address: SocketAddr,
}

impl Bound {
    /// Prints the address, after `scheme`, as one line of standard output. If that line cannot be written, the service runs
    /// all the same.
    pub(crate) fn announce(self, scheme: &str) -> Incoming {
        let Self { incoming, address } = self;
        if let Err(failed) = output::print(format_args!("listening on {scheme}{address}")) {
            let error = failed.into_error();
            tracing::warn!(%address, "cannot print the address: {error:#}");
        }
        incoming
    }
}

/// Binds the address and prints it.
pub(crate) async fn listen(args: &ListenArgs) -> Result<Incoming, Failed> {
    Ok(bind(args).await?.announce(""))
}

/// Binds the address as [`listen`] and prints it as a URI, which is the contract for environment servers.
pub(super) async fn listen_with_scheme(args: &ListenArgs) -> Result<Incoming, Failed> {
    let scheme = if args.tls_cert.is_some() { "https://" } else { "http://" };
    Ok(bind(args).await?.announce(scheme))
}

/// Binds the address. The service keeps as many connections as the limit of open files allows.
pub(crate) async fn bind(args: &ListenArgs) -> Result<Bound, Failed> {
    let capacity = Capacity::for_open_files(fd_limit::raise());
    let bind = async {
        let listener = TcpListener::bind(args.listen).await?;
        let address = listener.local_addr()?;
        Ok::<_, std::io::Error>((listener, address))
    };
    let (listener, address) = bind.await.map_err(|error| cannot_listen(args, error))?;
    Ok(Bound { incoming: Incoming::from(listener).with_capacity(capacity), address })
}

fn cannot_listen(args: &ListenArgs, error: std::io::Error) -> Failed {
    let advice = match error.kind() {
        ErrorKind::AddrInUse => {
            ": stop the program that uses it, or choose another --listen (port 0 selects a free port)"
        }
        _ => "",
    };
    Failed::new(Exit::TryAgain, error).context(format!("cannot listen on {}{advice}", args.listen))
}
