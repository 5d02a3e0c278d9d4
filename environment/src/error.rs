//! Errors of the environment service.

use tandem_sim::SimError;

/// An error that ends the environment service.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The environments cannot be built.
    #[error("the environments cannot be built")]
    World(#[from] SimError),
    /// The service cannot be offered.
    #[error("the service cannot be offered")]
    ServerConfig(#[from] tandem_net::ServerConfigError),
    /// The server failed.
    #[error("the server failed")]
    Transport(#[from] tonic::transport::Error),
}
