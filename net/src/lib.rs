//! How processes reach one another: who may call a service, how a service is offered, how it is called.
//!
//! [`Gate`] is a service's side: its token, its certificate, and what it offers beside its calls (health, reflection,
//! keep-alive). [`Dial`] is a client's side. [`Incoming`] and [`Dial::through`] let both run over any network, a
//! simulated one included. What is said over a connection is not known here.

mod access;
mod dial;
mod gate;
mod incoming;

pub use access::{AccessError, Token, TokenRefused};
pub use dial::{Bearer, Dial, DialError, Link};
pub use gate::{Gate, GateError, Guard};
pub use incoming::{Connection, Incoming};
