//! Asking a service whether it serves (`grpc.health.v1`).

use std::time::Duration;

use tonic::{Code, Status};
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_client::HealthClient;

use crate::link::Link;

/// Why a service does not count as serving.
#[derive(Debug, thiserror::Error)]
pub enum Unwell {
    /// It says so.
    #[error("not serving")]
    NotServing,
    /// There is no such service at that address.
    #[error("there is no service {0:?}")]
    NoSuchService(String),
    /// No answer in time.
    #[error("no answer within {0:?}")]
    Silent(Duration),
    /// It cannot be asked.
    #[error("{}", .0.message())]
    Unreachable(Status),
}

/// Asks whether `service`, or all there is when it is empty, serves; waits for an answer no longer than `deadline`.
///
/// # Errors
/// When it does not serve, or does not say so in time.
pub async fn check_health(link: Link, service: &str, deadline: Duration) -> Result<(), Unwell> {
    let request = HealthCheckRequest { service: service.to_owned() };
    let mut client = HealthClient::new(link);
    let answer = tokio::time::timeout(deadline, client.check(request))
        .await
        .map_err(|_elapsed| Unwell::Silent(deadline))?;
    match answer {
        Ok(answer) if answer.get_ref().status() == ServingStatus::Serving => Ok(()),
        Ok(_) => Err(Unwell::NotServing),
        Err(status) if status.code() == Code::NotFound => {
            Err(Unwell::NoSuchService(service.to_owned()))
        }
        Err(status) => Err(Unwell::Unreachable(status)),
    }
}
