//! A service that counts its calls, and generated certificates.

use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};

use rcgen::{BasicConstraints, CertificateParams, CertifiedIssuer, DnType, IsCa, KeyPair};
use tandem_net::{Incoming, ServerConfig, Token, TraceContext};
use tandem_proto::pb;
use tandem_proto::pb::teacher_server::{Teacher, TeacherServer};
use tokio::net::TcpListener;
use tokio::task::JoinHandle;
use tokio_stream::Stream;
use tokio_util::sync::CancellationToken;
use tonic::{Request, Response, Status, Streaming};

pub(crate) const SECRET: &str = "the-right-token-0123";
pub(crate) const OTHER: &str = "another-token-456789";

pub(crate) fn token(text: &str) -> Token {
    Token::new(text).expect("a token")
}

/// A service that counts its calls and returns empty responses.
#[derive(Clone, Default)]
pub(crate) struct Counter {
    n_calls: Arc<AtomicU64>,
    /// The trace contexts of the calls of `Describe`.
    traces: Arc<Mutex<Vec<Option<TraceContext>>>>,
}

impl Counter {
    pub(crate) fn n_calls(&self) -> u64 {
        self.n_calls.load(Ordering::SeqCst)
    }

    pub(crate) fn traces(&self) -> Vec<Option<TraceContext>> {
        self.traces.lock().expect("no panic").clone()
    }

    fn count<T: Default>(&self) -> Result<Response<T>, Status> {
        self.n_calls.fetch_add(1, Ordering::SeqCst);
        Ok(Response::new(T::default()))
    }
}

#[tonic::async_trait]
impl Teacher for Counter {
    type AdviseStreamStream =
        Pin<Box<dyn Stream<Item = Result<pb::AdviseResponse, Status>> + Send>>;

    async fn describe(
        &self,
        request: Request<pb::DescribeRequest>,
    ) -> Result<Response<pb::DescribeResponse>, Status> {
        let trace = request.extensions().get().copied();
        self.traces.lock().expect("no panic").push(trace);
        self.count()
    }

    async fn open_account(
        &self,
        _: Request<pb::OpenAccountRequest>,
    ) -> Result<Response<pb::Account>, Status> {
        self.count()
    }

    async fn get_account(
        &self,
        _: Request<pb::GetAccountRequest>,
    ) -> Result<Response<pb::Account>, Status> {
        self.count()
    }

    async fn advise(
        &self,
        _: Request<pb::AdviseRequest>,
    ) -> Result<Response<pb::AdviseResponse>, Status> {
        self.count()
    }

    async fn advise_stream(
        &self,
        _: Request<Streaming<pb::AdviseRequest>>,
    ) -> Result<Response<Self::AdviseStreamStream>, Status> {
        self.count::<()>()?;
        Ok(Response::new(Box::pin(tokio_stream::once(Ok(pb::AdviseResponse::default())))))
    }

    async fn open_leases(
        &self,
        _: Request<pb::OpenLeasesRequest>,
    ) -> Result<Response<pb::OpenLeasesResponse>, Status> {
        self.count()
    }

    async fn settle_leases(
        &self,
        _: Request<pb::SettleLeasesRequest>,
    ) -> Result<Response<pb::Account>, Status> {
        self.count()
    }
}

/// A server of a [`Counter`], which stops when it is dropped.
pub(crate) struct Served {
    pub(crate) counter: Counter,
    pub(crate) address: SocketAddr,
    serving: JoinHandle<()>,
}

impl Served {
    pub(crate) async fn start(config: &ServerConfig) -> Self {
        Self::start_on(TcpListener::bind("127.0.0.1:0").await.expect("a port"), config).await
    }

    pub(crate) async fn start_on(listener: TcpListener, config: &ServerConfig) -> Self {
        let address = listener.local_addr().expect("bound");
        let (counter, serving) = serve(listener, config).await;
        Self { counter, address, serving }
    }

    /// Stops the server, closes its connections and returns a new listener on the same address.
    pub(crate) async fn stop(mut self) -> TcpListener {
        self.serving.abort();
        drop((&mut self.serving).await);
        TcpListener::bind(self.address).await.expect("the port is still free")
    }
}

impl Drop for Served {
    fn drop(&mut self) {
        self.serving.abort();
    }
}

/// Serves a counter to `incoming`.
pub(crate) async fn serve(
    incoming: impl Into<Incoming>,
    config: &ServerConfig,
) -> (Counter, JoinHandle<()>) {
    let counter = Counter::default();
    let router = config
        .router(TeacherServer::new(counter.clone()), tandem_proto::FILE_DESCRIPTOR_SET)
        .await
        .expect("valid");
    let incoming = incoming.into();
    let serving = tokio::spawn(async move {
        tandem_net::serve(router, incoming, CancellationToken::new()).await.expect("serves");
    });
    (counter, serving)
}

/// A certificate authority.
pub(crate) struct Authority(CertifiedIssuer<'static, KeyPair>);

/// A certificate and its key (PEM).
pub(crate) struct Identity {
    pub(crate) certificate: String,
    pub(crate) key: String,
}

impl Authority {
    pub(crate) fn new(name: &str) -> Self {
        let mut params = CertificateParams::new([]).expect("no names");
        params.distinguished_name.push(DnType::CommonName, name);
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        let key = KeyPair::generate().expect("a key");
        Self(CertifiedIssuer::self_signed(params, key).expect("a certificate"))
    }

    pub(crate) fn pem(&self) -> String {
        self.0.pem()
    }

    /// Signs a certificate for `name` with a distant expiry.
    pub(crate) fn sign(&self, name: &str) -> Identity {
        self.sign_until(name, 4000)
    }

    /// Signs a certificate for `name` that expires on the first day of `year`.
    pub(crate) fn sign_until(&self, name: &str, year: i32) -> Identity {
        let mut params = CertificateParams::new([name.to_owned()]).expect("a name");
        params.not_after = rcgen::date_time_ymd(year, 1, 1);
        let key = KeyPair::generate().expect("a key");
        let certificate = params.signed_by(&key, &self.0).expect("signs");
        Identity { certificate: certificate.pem(), key: key.serialize_pem() }
    }
}

impl Identity {
    /// Adds this identity to `config`.
    pub(crate) fn add_to(&self, config: ServerConfig) -> ServerConfig {
        config.with_certificate(self.certificate.as_bytes(), self.key.as_bytes()).expect("fits")
    }
}
