//! How processes reach one another: who may call a service, how a service is offered, how it is called.
//!
//! [`Gate`] is a service's side: its token, its certificate, and what it offers beside its calls (health, reflection,
//! keep-alive); [`serve()`] runs it until it is shut down. An answer that goes to many clients is [`Prepared`] once.
//! [`Dial`] is a client's side; its [`Link`]s say what to do when a call fails. [`Incoming`] and [`Dial::through`] let
//! both run over any network, a simulated one included; [`Pacing`] is how services and their threads take turns on it.
//! [`Page`] is what a service shows to programs that speak plain HTTP. The messages themselves are not known here.

mod access;
mod admission;
mod connection;
mod dial;
mod elsewhere;
mod gate;
mod health;
mod heard;
mod incoming;
mod link;
mod pacing;
mod page;
mod prepared;
mod serve;
mod throttle;
mod tls;

pub use access::{AccessError, Token, TokenRefused, is_exposed};
pub use admission::Capacity;
pub use connection::{Caller, Connection, Hangup, Noting, NotingRequests};
pub use dial::{Dial, DialError};
pub use gate::{Gate, GateError, Guard, Router};
pub use health::{Unwell, check_health};
pub use incoming::Incoming;
pub use link::Link;
pub use pacing::Pacing;
pub use page::Page;
pub use prepared::Prepared;
pub use serve::{SHUTDOWN_GRACE, serve};
pub use tls::TlsError;
