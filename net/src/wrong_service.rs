//! Error messages for calls that reach a service of another kind, as when two addresses are swapped.

use http::{HeaderName, HeaderValue};
use tonic::body::Body;
use tonic::server::NamedService;
use tonic::{Code, Status};

/// The response header that names the service at an address, sent with responses to unknown calls.
const SERVED: HeaderName = HeaderName::from_static("tandem-service");

/// Adds the name of the service `S` to a response to an unknown call.
pub(crate) fn name_service<S: NamedService>(
    mut response: http::Response<Body>,
) -> http::Response<Body> {
    if is_unknown_call(&response) {
        response.headers_mut().insert(SERVED, HeaderValue::from_static(S::NAME));
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
    Some(Status::unimplemented(match served {
        Some(served) if served == called => {
            format!("the {name} at {address} does not know {path}: it is of another version")
        }
        Some(served) => {
            let served = short_name(served);
            let [served, name] = [&served, &name].map(|name| with_article(name));
            format!("the service at {address} is {served}, not {name}: check the address")
        }
        None => format!("the service at {address} does not offer {called}: check the address"),
    }))
}

fn with_article(name: &str) -> String {
    let article = if name.starts_with(['a', 'e', 'i', 'o', 'u']) { "an" } else { "a" };
    format!("{article} {name}")
}

/// Returns the last part of a service's name, in lower case: `teacher` for `tandem.v1.Teacher`.
fn short_name(service: &str) -> String {
    service.rsplit('.').next().unwrap_or(service).to_lowercase()
}
