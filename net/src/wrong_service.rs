//! Error messages for calls that reach a service of another kind, as when two addresses are swapped.

use http::{HeaderName, HeaderValue};
use tonic::body::Body;
use tonic::server::NamedService;
use tonic::{Code, Status};

/// The response header that names the service at an address, sent with responses to unknown calls.
const SERVED: &str = "tandem-service";
/// Metadata of the status that the caller gets: the address that it has called.
const ADDRESS: &str = "tandem-address";

/// The service that has answered a call meant for a service of another kind.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct WrongService {
    /// The service in lower case: `teacher`, `learner`, `worker`, `bridge`, `environment` or `policy`.
    pub name: String,
    /// The address as the caller gave it.
    pub address: String,
}

impl WrongService {
    /// Returns the service that caused `status`; `None` if the status has another cause.
    #[must_use]
    pub fn of(status: &Status) -> Option<Self> {
        let entry = |key| Some(status.metadata().get(key)?.to_str().ok()?.to_owned());
        Some(Self { name: short_name(&entry(SERVED)?), address: entry(ADDRESS)? })
    }
}

/// Adds the name of the service `S` to a response to an unknown call.
pub(crate) fn name_service<S: NamedService>(
    mut response: http::Response<Body>,
) -> http::Response<Body> {
    if is_unknown_call(&response) {
        response
            .headers_mut()
            .insert(HeaderName::from_static(SERVED), HeaderValue::from_static(S::NAME));
    }
    response
}

/// Returns whether the server does not know the call. An `UNIMPLEMENTED` with a message comes from the service itself.
fn is_unknown_call(response: &http::Response<Body>) -> bool {
    Status::from_header_map(response.headers())
        .is_some_and(|status| status.code() == Code::Unimplemented && status.message().is_empty())
}

/// Returns the status of a call to `path` that the server at `address` does not know; `None` for any other response.
pub(crate) fn unknown_call(
    address: &str,
    path: &str,
    response: &http::Response<Body>,
) -> Option<Status> {
    if !is_unknown_call(response) {
        return None;
    }
    let called = path.trim_start_matches('/').split('/').next().unwrap_or_default();
    let served = response.headers().get(SERVED).and_then(|name| name.to_str().ok());
    let name = short_name(called);
    let Some(served) = served else {
        return Some(Status::unimplemented(format!(
            "the service at {address} does not offer {called}: check the address"
        )));
    };
    if served == called {
        return Some(Status::unimplemented(format!(
            "the {name} at {address} does not know {path}: it is of another version"
        )));
    }
    let [is, wanted] = [&short_name(served), &name].map(|name| with_article(name));
    let message = format!("the service at {address} is {is}, not {wanted}: check the address");
    let mut status = Status::unimplemented(message);
    for (key, value) in [(SERVED, served), (ADDRESS, address)] {
        if let Ok(value) = value.parse() {
            status.metadata_mut().insert(key, value);
        }
    }
    Some(status)
}

fn with_article(name: &str) -> String {
    let article = if name.starts_with(['a', 'e', 'i', 'o', 'u']) { "an" } else { "a" };
    format!("{article} {name}")
}

/// Returns the last part of a service's name, in lower case: `teacher` for `tandem.v1.Teacher`.
fn short_name(service: &str) -> String {
    service.rsplit('.').next().unwrap_or(service).to_lowercase()
}
