//! The simulated network: how services listen on it and how they are called over it.

use std::net::Ipv4Addr;
use std::time::Duration;

use tandem_net::{ClientConfig, Connection, Incoming};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use turmoil::net::{TcpListener, TcpStream};

use crate::cluster::LEARNER;

/// Where every service listens on its host.
const PORT: u16 = 7000;

/// The address of the service on `host`.
pub(crate) fn address(host: &str) -> String {
    format!("{host}:{PORT}")
}

/// Calls services over the simulated network.
pub(crate) fn client_config() -> ClientConfig {
    ClientConfig::default().with_connector(|uri| async move {
        let host = uri.host().expect("an address has a host").to_owned();
        let port = uri.port_u16().expect("an address has a port");
        TcpStream::connect((host, port)).await.map(Connection::new)
    })
}

/// The connections that reach the host on which it is called.
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

/// Connects to the learner as soon as it listens, and leaves it at that.
pub(crate) async fn say_nothing_to_learner() -> turmoil::Result {
    let _connection = loop {
        match TcpStream::connect((LEARNER, PORT)).await {
            Ok(connection) => break connection,
            Err(_) => tokio::time::sleep(Duration::from_millis(50)).await,
        }
    };
    std::future::pending().await
}
