//! Connections between processes: access control, TLS, keep-alive, health, reflection, retries and metrics.
//!
//! The server's side:
//! - [`ServerConfig`] holds a service's token and certificate, and builds its [`Router`]; [`serve()`] runs the router
//!   until shutdown.
//! - [`Incoming`] accepts connections from any network, within a [`Capacity`].
//! - [`EncodedResponse`] is encoded once and sent to many clients.
//! - [`TextEndpoint`] serves a text over plain HTTP.
//! - [`TraceContext`] follows the work on a slot across processes.
//! - [`Metrics`] measures calls and other work, and writes a page for Prometheus.
//!
//! The client's side:
//! - [`ClientConfig`] holds a token and the trusted authority, and opens [`AuthChannel`]s, whose errors name the
//!   address and the remedy.
//! - [`Retrier`] and [`retry()`] repeat failed calls; [`within`] sets a deadline.
//!
//! [`ServerConfig`] and [`ClientConfig`] run over any network, including a simulated one. [`Pacing`] determines whether
//! a runtime serves sockets while threads compute. The crate does not know the messages that connections carry.
#![warn(missing_docs)]

mod access;
mod admission;
mod block_on;
mod channel;
mod client;
mod connection;
mod encoded_response;
mod health;
mod incoming;
pub mod metrics;
mod pacing;
mod retry;
mod serve;
mod server;
mod text_endpoint;
mod throttle;
mod tls;
mod tls_probe;
mod trace;
mod wrong_service;

pub use access::{AccessError, Token, TokenError, is_exposed};
pub use admission::Capacity;
pub use block_on::block_on;
pub use channel::{AuthChannel, NOTHING_LISTENS};
pub use client::{ClientConfig, ClientConfigError};
pub use connection::{ConnectInfo, Connection, ConnectionClosed, MarkRequest, MarkRequestLayer};
pub use encoded_response::EncodedResponse;
pub use health::{HealthError, HealthReporter, check_health};
pub use incoming::Incoming;
pub use metrics::Metrics;
pub use pacing::Pacing;
pub use retry::{Backoff, Operation, Retrier, Retryability, retry, within};
pub use serve::{SHUTDOWN_GRACE, serve};
pub use server::{Router, ServerConfig, ServerConfigError, TokenInterceptor};
pub use text_endpoint::TextEndpoint;
pub use tls::TlsError;
pub use trace::{InvalidTraceContext, TraceContext};
pub use wrong_service::WrongService;

/// The largest message that services and clients accept, in bytes: several times the episodes of a slot or the
/// parameters of a large actor.
pub const MAX_MESSAGE_BYTES: usize = 64 << 20;
