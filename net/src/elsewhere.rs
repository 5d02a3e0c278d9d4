//! Calls that reach a service of another kind, as when two addresses are swapped.

use std::time::Duration;

use tandem_proto::pb::{bridge_server, learner_server, teacher_server};
use tonic::transport::Channel;
use tonic::{Code, Status};
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::health_client::HealthClient;

/// The services of a run and what their processes are called.
const SERVICES: [(&str, &str); 3] = [
    (learner_server::SERVICE_NAME, "learner"),
    (teacher_server::SERVICE_NAME, "teacher"),
    (bridge_server::SERVICE_NAME, "bridge"),
];
/// The time in which the process at an address must say what it is.
const PATIENCE: Duration = Duration::from_secs(2);

/// Whether the service does not know the call that it answers. A service that explains itself is not asked again.
pub(crate) fn is_unknown_call(response: &http::Response<tonic::body::Body>) -> bool {
    Status::from_header_map(response.headers())
        .is_some_and(|status| status.code() == Code::Unimplemented && status.message().is_empty())
}

/// Explains why the process at `address` does not know the call `path`.
pub(crate) async fn explain(address: &str, path: &str, channel: Channel) -> Status {
    let wanted = path.trim_start_matches('/').split('/').next().unwrap_or_default();
    let offered = tokio::time::timeout(PATIENCE, offered(channel)).await.ok().flatten();
    Status::unimplemented(match (name_of(wanted), offered) {
        (Some(name), Some(service)) if service == wanted => {
            format!("the {name} at {address} does not know {path}: it is of another version")
        }
        (Some(name), Some(service)) => {
            let found = name_of(service).unwrap_or(service);
            format!("the service at {address} is a {found}, not a {name}: check the address")
        }
        (Some(name), None) => {
            format!("the service at {address} is not a {name}: check the address")
        }
        (None, _) => format!("the service at {address} does not offer {wanted}"),
    })
}

fn name_of(service: &str) -> Option<&'static str> {
    SERVICES.iter().find(|(known, _)| *known == service).map(|(_, name)| *name)
}

/// Asks the process which of the services it offers.
async fn offered(channel: Channel) -> Option<&'static str> {
    let mut health = HealthClient::new(channel);
    for (service, _) in SERVICES {
        let request = HealthCheckRequest { service: service.to_owned() };
        let answer = health.check(request).await;
        if answer.is_ok_and(|answer| answer.get_ref().status() == ServingStatus::Serving) {
            return Some(service);
        }
    }
    None
}
