//! The standard health service (`grpc.health.v1`): a client, and the health of a process that reports its own.

use std::time::Duration;

use tonic::{Code, Status};
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_client::HealthClient;
use tonic_health::server::HealthReporter as Reporter;

use crate::channel::AuthChannel;

/// The name of all services of a server together.
const WHOLE_SERVER: &str = "";

/// Sets the health of a process that has a [`health_router`](crate::ServerConfig::health_router).
#[derive(Debug, Clone)]
pub struct HealthReporter {
    reporter: Reporter,
    service: &'static str,
}

impl HealthReporter {
    pub(crate) const fn new(reporter: Reporter, service: &'static str) -> Self {
        Self { reporter, service }
    }

    /// Sets whether the process is serving, for checks that name its service and for those that name none.
    pub async fn set_serving(&self, is_serving: bool) {
        let status = match is_serving {
            true => tonic_health::ServingStatus::Serving,
            false => tonic_health::ServingStatus::NotServing,
        };
        for service in [WHOLE_SERVER, self.service] {
            self.reporter.set_service_status(service, status).await;
        }
    }
}

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
