//! Listeners and clients on the simulated network.

use std::net::Ipv4Addr;
use std::time::Duration;

use tandem_net::{ClientConfig, Connection, Incoming};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use turmoil::net::{TcpListener, TcpStream};

use crate::cluster::LEARNER;

/// Port of every service.
const PORT: u16 = 7000;

/// Returns the address of the service on `host`.
pub(crate) fn address(host: &str) -> String {
    format!("{host}:{PORT}")
}

/// Returns a client configuration that connects over the simulated network.
pub(crate) fn client_config() -> ClientConfig {
    ClientConfig::default().with_connector(|uri| async move {
        let host = uri.host().expect("an address has a host").to_owned();
        let port = uri.port_u16().expect("an address has a port");
        TcpStream::connect((host, port)).await.map(Connection::new)
    })
}

/// Accepts connections on the calling host.
pub(crate) async fn listen() -> std::io::Result<Incoming> {
    let listener = TcpListener::bind((Ipv4Addr::UNSPECIFIED, PORT)).await?;
    let (sender, accepted) = mpsc::channel(1);
    tokio::spawn(async move {
        loop {
            let connection = listener.accept().await.map(|(stream, _)| Connection::new(stream));
            if sender.send(connection).await.is_err() {
                return;
            }
        }
    });
    Ok(Incoming::new(ReceiverStream::new(accepted)))
}

/// Connects to the learner as soon as it listens and never sends anything.
pub(crate) async fn idle_client() -> turmoil::Result {
    let _connection = loop {
        match TcpStream::connect((LEARNER, PORT)).await {
            Ok(connection) => break connection,
            Err(_) => tokio::time::sleep(Duration::from_millis(50)).await,
        }
    };
    std::future::pending().await
}
