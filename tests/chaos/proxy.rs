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

/// The current state of the proxy.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct LinkState {
    disturbance: Option<Disturbance>,
    /// Number of cuts. Each cut closes all older connections.
    n_cuts: u64,
}

/// A proxy for one address. It ends with its runtime.
#[derive(Debug)]
pub(crate) struct Proxy {
    address: SocketAddr,
    state: watch::Sender<LinkState>,
}

impl Proxy {
    /// Listens on a free port and forwards connections to `upstream`.
    pub(crate) async fn start(upstream: SocketAddr) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("a free port");
        let address = listener.local_addr().expect("bound");
        let (state, receiver) = watch::channel(LinkState { disturbance: None, n_cuts: 0 });
        tokio::spawn(listen(listener, address, upstream, receiver));
        Self { address, state }
    }

    /// Returns the address of the proxy.
    pub(crate) const fn address(&self) -> SocketAddr {
        self.address
    }

    /// Closes all connections.
    pub(crate) fn cut(&self) {
        self.state.send_modify(|state| state.n_cuts += 1);
    }

    /// Starts a disturbance of all connections, or ends it with `None`.
    pub(crate) fn disturb(&self, disturbance: Option<Disturbance>) {
        self.state.send_modify(|state| {
            state.disturbance = disturbance;
            if disturbance == Some(Disturbance::Refuse) {
                state.n_cuts += 1;
            }
        });
    }
}

type StateReceiver = watch::Receiver<LinkState>;

/// Waits until `condition` holds. Returns false if the proxy was dropped.
async fn wait_for(state: &mut StateReceiver, condition: impl Fn(LinkState) -> bool) -> bool {
    state.wait_for(|state| condition(*state)).await.is_ok()
}

/// Accepts connections. Closes the listener while connections are refused.
async fn listen(
    mut listener: TcpListener,
    address: SocketAddr,
    upstream: SocketAddr,
    mut state: StateReceiver,
) {
    let refuses = |state: LinkState| state.disturbance == Some(Disturbance::Refuse);
    loop {
        tokio::select! {
            accepted = listener.accept() => {
                if let Ok((client, _)) = accepted {
                    tokio::spawn(serve(client, upstream, state.clone()));
                }
            }
            is_open = wait_for(&mut state, refuses) => {
                drop(listener);
                if !is_open || !wait_for(&mut state, |state| !refuses(state)).await {
                    return;
                }
                listener = rebind(address).await;
            }
        }
    }
}

/// Binds the port again, which may briefly be in use.
async fn rebind(address: SocketAddr) -> TcpListener {
    for _ in 0..1_000 {
        if let Ok(listener) = TcpListener::bind(address).await {
            return listener;
        }
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    panic!("the proxy's port {address} is taken");
}

/// Forwards one connection until one side closes or it is cut.
async fn serve(mut client: TcpStream, upstream: SocketAddr, mut state: StateReceiver) {
    let n_cuts = state.borrow().n_cuts;
    let (mut cuts, mut losses) = (state.clone(), state.clone());
    let half_open = |state: LinkState| state.disturbance == Some(Disturbance::HalfOpen);
    let pass_on = async {
        let is_lost = tokio::select! {
            () = relay(&mut client, upstream, state.clone()) => false,
            is_open = wait_for(&mut losses, half_open) => is_open,
        };
        if is_lost {
            // The upstream side is closed. The client side is closed when the disturbance ends.
            wait_for(&mut state, |state| !half_open(state)).await;
        }
    };
    tokio::select! {
        () = pass_on => (),
        _ = wait_for(&mut cuts, |state| state.n_cuts != n_cuts) => (),
    }
}

async fn relay(near: &mut TcpStream, upstream: SocketAddr, state: StateReceiver) {
    let Ok(mut far) = TcpStream::connect(upstream).await else { return };
    drop((near.set_nodelay(true), far.set_nodelay(true)));
    let (near_in, near_out) = near.split();
    let (far_in, far_out) = far.split();
    let requests = |disturbance| disturbance != Some(Disturbance::Blackhole);
    let answers =
        |disturbance| !matches!(disturbance, Some(Disturbance::Blackhole | Disturbance::OneWay));
    tokio::select! {
        () = forward(near_in, far_out, state.clone(), requests) => (),
        () = forward(far_in, near_out, state, answers) => (),
    }
}

/// Forwards bytes while the state lets them pass. Bytes that are held back are forwarded later.
async fn forward(
    mut from: ReadHalf<'_>,
    mut to: WriteHalf<'_>,
    mut state: StateReceiver,
    passes: impl Fn(Option<Disturbance>) -> bool,
) {
    let mut chunk = vec![0; CHUNK_BYTES];
    while let Ok(n_bytes @ 1..) = from.read(&mut chunk).await {
        let passed = wait_for(&mut state, |state| passes(state.disturbance)).await;
        if !passed || to.write_all(&chunk[..n_bytes]).await.is_err() {
            return;
        }
    }
}
