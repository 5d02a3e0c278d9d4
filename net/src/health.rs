//! A client for the standard health service (`grpc.health.v1`).

use std::time::Duration;

use tonic::{Code, Status};
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_client::HealthClient;

use crate::channel::AuthChannel;

/// The result of a health check that did not succeed.
#[derive(Debug, thiserror::Error)]
pub enum HealthError {
    /// The service reports that it is not serving.
    #[error("not serving")]
    NotServing,
    /// The server does not offer this service.
    #[error("there is no service {0:?}")]
    UnknownService(String),
    /// The server did not answer before the deadline.
    #[error("no answer within {0:?}")]
    Timeout(Duration),
    /// The call failed.
    #[error("{}", .0.message())]
    Unreachable(Status),
}

/// Checks that `service` is serving, or the whole server if `service` is empty.
///
/// # Errors
/// When the service is not serving, is unknown, or does not answer before the deadline.
pub async fn check_health(
    channel: AuthChannel,
    service: &str,
    deadline: Duration,
) -> Result<(), HealthError> {
    let request = HealthCheckRequest { service: service.to_owned() };
    let mut client = HealthClient::new(channel);
    let answer = tokio::time::timeout(deadline, client.check(request))
        .await
        .map_err(|_elapsed| HealthError::Timeout(deadline))?;
    match answer {
        Ok(answer) if answer.get_ref().status() == ServingStatus::Serving => Ok(()),
        Ok(_) => Err(HealthError::NotServing),
        Err(status) if status.code() == Code::NotFound => {
            Err(HealthError::UnknownService(service.to_owned()))
        }
        Err(status) => Err(HealthError::Unreachable(status)),
    }
}
