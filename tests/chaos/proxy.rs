//! A TCP proxy whose connections can be disturbed.

use std::net::SocketAddr;
use std::time::Duration;

use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::tcp::{ReadHalf, WriteHalf};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;

use crate::schedule::Disturbance;

/// Bytes forwarded at a time.
const CHUNK_BYTES: usize = 16 << 10;

/// What the proxy does at present.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Weather {
    disturbance: Option<Disturbance>,
    /// Connections that are older than the latest cut are closed.
    n_cuts: u64,
}

/// A proxy in front of one address; it ends with its runtime.
#[derive(Debug)]
pub(crate) struct Proxy {
    address: SocketAddr,
    weather: watch::Sender<Weather>,
}

impl Proxy {
    /// Listens on a free port and passes connections on to `upstream`.
    pub(crate) async fn start(upstream: SocketAddr) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("a free port");
        let address = listener.local_addr().expect("bound");
        let (weather, receiver) = watch::channel(Weather { disturbance: None, n_cuts: 0 });
        tokio::spawn(listen(listener, address, upstream, receiver));
        Self { address, weather }
    }

    /// Where to connect to.
    pub(crate) const fn address(&self) -> SocketAddr {
        self.address
    }

    /// Closes all connections.
    pub(crate) fn cut(&self) {
        self.weather.send_modify(|weather| weather.n_cuts += 1);
    }

    /// Disturbs all connections from now on, or no longer.
    pub(crate) fn disturb(&self, disturbance: Option<Disturbance>) {
        self.weather.send_modify(|weather| {
            weather.disturbance = disturbance;
            if disturbance == Some(Disturbance::Refuse) {
                weather.n_cuts += 1;
            }
        });
    }
}

type Forecast = watch::Receiver<Weather>;

/// Waits for weather that `is_so`; gives false when the proxy is gone.
async fn wait_for(weather: &mut Forecast, is_so: impl Fn(Weather) -> bool) -> bool {
    weather.wait_for(|weather| is_so(*weather)).await.is_ok()
}

/// Takes connections; while they are to be refused nobody listens at all.
async fn listen(
    mut listener: TcpListener,
    address: SocketAddr,
    upstream: SocketAddr,
    mut weather: Forecast,
) {
    let refuses = |weather: Weather| weather.disturbance == Some(Disturbance::Refuse);
    loop {
        tokio::select! {
            accepted = listener.accept() => {
                if let Ok((client, _)) = accepted {
                    tokio::spawn(serve(client, upstream, weather.clone()));
                }
            }
            is_there = wait_for(&mut weather, refuses) => {
                drop(listener);
                if !is_there || !wait_for(&mut weather, |weather| !refuses(weather)).await {
                    return;
                }
                listener = bind_again(address).await;
            }
        }
    }
}

/// Takes the port back, which somebody may hold for a moment.
async fn bind_again(address: SocketAddr) -> TcpListener {
    for _ in 0..1_000 {
        if let Ok(listener) = TcpListener::bind(address).await {
            return listener;
        }
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    panic!("the proxy's port {address} is taken");
}

/// Passes one connection on until an end closes or it is cut.
async fn serve(mut client: TcpStream, upstream: SocketAddr, mut weather: Forecast) {
    let n_cuts = weather.borrow().n_cuts;
    let (mut cuts, mut losses) = (weather.clone(), weather.clone());
    let half_open = |weather: Weather| weather.disturbance == Some(Disturbance::HalfOpen);
    let pass_on = async {
        let is_lost = tokio::select! {
            () = relay(&mut client, upstream, weather.clone()) => false,
            is_there = wait_for(&mut losses, half_open) => is_there,
        };
        if is_lost {
            // The far end is closed by now; the near one hears of it when this is over.
            wait_for(&mut weather, |weather| !half_open(weather)).await;
        }
    };
    tokio::select! {
        () = pass_on => (),
        _ = wait_for(&mut cuts, |weather| weather.n_cuts != n_cuts) => (),
    }
}

async fn relay(near: &mut TcpStream, upstream: SocketAddr, weather: Forecast) {
    let Ok(mut far) = TcpStream::connect(upstream).await else { return };
    drop((near.set_nodelay(true), far.set_nodelay(true)));
    let (near_in, near_out) = near.split();
    let (far_in, far_out) = far.split();
    let requests = |disturbance| disturbance != Some(Disturbance::Blackhole);
    let answers =
        |disturbance| !matches!(disturbance, Some(Disturbance::Blackhole | Disturbance::OneWay));
    tokio::select! {
        () = forward(near_in, far_out, weather.clone(), requests) => (),
        () = forward(far_in, near_out, weather, answers) => (),
    }
}

/// Passes on what comes in, as long as the weather lets it pass; what is held back is passed on later.
async fn forward(
    mut from: ReadHalf<'_>,
    mut to: WriteHalf<'_>,
    mut weather: Forecast,
    passes: impl Fn(Option<Disturbance>) -> bool,
) {
    let mut chunk = vec![0; CHUNK_BYTES];
    while let Ok(n_bytes @ 1..) = from.read(&mut chunk).await {
        let passed = wait_for(&mut weather, |weather| passes(weather.disturbance)).await;
        if !passed || to.write_all(&chunk[..n_bytes]).await.is_err() {
            return;
        }
    }
}
