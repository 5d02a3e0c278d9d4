//! The access to a page, and the headers that keep other pages of the same browser out.
//!
//! A page that needs no token is protected by the address that it listens on. Two attacks of other web pages in the
//! viewer's browser remain: a name that is rebound to that address, which the check of `Host` refuses, and a request to
//! act, which needs a header that only this page's script may send.

use std::net::{IpAddr, Ipv6Addr};
use std::sync::Arc;

use axum::body::Body;
use axum::extract::State;
use axum::middleware::Next;
use axum::response::{Html, IntoResponse as _, Response};
use http::header::{
    AUTHORIZATION, CACHE_CONTROL, CONTENT_SECURITY_POLICY, COOKIE, HOST, ORIGIN, REFERRER_POLICY,
    SET_COOKIE, X_CONTENT_TYPE_OPTIONS,
};
use http::{HeaderMap, HeaderName, HeaderValue, Method, Request, StatusCode};
use sha2::{Digest as _, Sha256};
use tandem_net::Token;

use crate::page;

/// Scripts, styles and data come from the page's own server only.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; \
    connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'";
/// The header of requests that act. A page of another server cannot send it without permission.
const ACTION_HEADER: &str = "x-tandem-action";

/// The rules of access to a site.
#[derive(Debug, Clone)]
pub struct Access {
    token: Option<Token>,
    /// Hexadecimal digest of the token, which browsers keep instead of it.
    cookie: String,
    /// True if names without a dot, as containers and machines of a local network have, are valid hosts.
    allows_short_names: bool,
}

impl Access {
    /// Requires no token. For addresses that only this machine can reach.
    #[must_use]
    pub const fn local() -> Self {
        Self { token: None, cookie: String::new(), allows_short_names: false }
    }

    /// Requires no token, although other machines can reach the address.
    #[must_use]
    pub const fn anyone() -> Self {
        Self { token: None, cookie: String::new(), allows_short_names: true }
    }

    /// Requires `token`, in the header `authorization: Bearer TOKEN` or once in the page's form.
    #[must_use]
    pub fn with_token(token: Token) -> Self {
        let digest = Sha256::digest(token.header());
        let cookie = digest.iter().map(|byte| format!("{byte:02x}")).collect();
        Self { token: Some(token), cookie, allows_short_names: true }
    }

    /// Returns true if the request may be answered.
    fn admits(&self, headers: &HeaderMap) -> bool {
        let Some(token) = &self.token else { return true };
        let header = headers.get(AUTHORIZATION).is_some_and(|sent| token.matches(sent.as_bytes()));
        header || headers.get_all(COOKIE).iter().any(|cookies| self.is_in(cookies))
    }

    /// Returns true if the digest of the token is among the cookies.
    fn is_in(&self, cookies: &HeaderValue) -> bool {
        let Ok(cookies) = cookies.to_str() else { return false };
        let expected = self.cookie_pair();
        cookies.split("; ").any(|pair| {
            let differences =
                pair.bytes().zip(expected.bytes()).fold(0, |sum, (a, b)| sum | (a ^ b));
            pair.len() == expected.len() && std::hint::black_box(differences) == 0
        })
    }

    /// Returns the cookie. Its name differs between tokens, because a browser sends the cookies of all ports of a host.
    fn cookie_pair(&self) -> String {
        format!("tandem-{}={}", self.cookie.get(..8).unwrap_or_default(), self.cookie)
    }

    /// Returns true if a browser that sends this `Host` can have come here without a name of a stranger. A cookie is
    /// not sent to such names, so a token needs no check.
    fn allows_host(&self, headers: &HeaderMap) -> bool {
        if self.token.is_some() {
            return true;
        }
        let Some(host) = headers.get(HOST).and_then(|host| host.to_str().ok()) else {
            return false;
        };
        let name = without_port(host);
        is_local_name(name) || (self.allows_short_names && is_short_name(name))
    }
}

/// Checks a request, answers it, and adds the headers of every response.
pub(crate) async fn guard(
    State(access): State<Arc<Access>>,
    request: Request<Body>,
    next: Next,
) -> Response {
    let mut response = match refusal(&access, &request) {
        Some(refusal) => refusal,
        None => {
            let logs_in = access.token.is_some() && request.uri().path() == "/login";
            let mut response = next.run(request).await;
            if logs_in && let Ok(cookie) = HeaderValue::from_str(&access.set_cookie()) {
                response.headers_mut().insert(SET_COOKIE, cookie);
            }
            response
        }
    };
    let headers = response.headers_mut();
    for (name, value) in [
        (CONTENT_SECURITY_POLICY, POLICY),
        (X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (REFERRER_POLICY, "no-referrer"),
        (CACHE_CONTROL, "no-store"),
        (HeaderName::from_static("cross-origin-resource-policy"), "same-origin"),
    ] {
        headers.insert(name, HeaderValue::from_static(value));
    }
    response
}

impl Access {
    fn set_cookie(&self) -> String {
        format!("{}; HttpOnly; SameSite=Strict; Path=/", self.cookie_pair())
    }
}

/// Returns the response to a request that is not served.
fn refusal(access: &Access, request: &Request<Body>) -> Option<Response> {
    let (headers, path) = (request.headers(), request.uri().path());
    if !access.allows_host(headers) {
        let text = "open this page by its IP address or as localhost\n";
        return Some((StatusCode::MISDIRECTED_REQUEST, text).into_response());
    }
    if *request.method() == Method::POST && !is_from_own_page(headers) {
        let text = "only this page may send this request\n";
        return Some((StatusCode::FORBIDDEN, text).into_response());
    }
    if access.admits(headers) || path.starts_with("/assets/") {
        return None;
    }
    if path == "/" {
        return Some((StatusCode::UNAUTHORIZED, Html(page::login().html)).into_response());
    }
    let text = "a token is required: authorization: Bearer TOKEN\n";
    Some((StatusCode::UNAUTHORIZED, text).into_response())
}

/// Returns true if a request that acts was sent by this page's script, or by a program that is no browser.
fn is_from_own_page(headers: &HeaderMap) -> bool {
    let text = |name| headers.get(name).and_then(|value: &HeaderValue| value.to_str().ok());
    let own = text(HOST).unwrap_or_default();
    let origin = text(ORIGIN).and_then(|origin| origin.split_once("://"));
    let is_own = match headers.contains_key(ORIGIN) {
        true => origin.is_some_and(|(_, host)| host == own),
        false => true,
    };
    is_own && headers.contains_key(ACTION_HEADER)
}

/// Returns the host of `HOST[:PORT]`.
fn without_port(host: &str) -> &str {
    match host.strip_prefix('[').and_then(|rest| rest.split_once(']')) {
        Some((address, _)) => address,
        None => host.split_once(':').map_or(host, |(name, _)| name),
    }
}

/// Returns true if no name server answers for `name`: it is an address, or `localhost`.
fn is_local_name(name: &str) -> bool {
    name.parse::<IpAddr>().is_ok()
        || name.parse::<Ipv6Addr>().is_ok()
        || name.eq_ignore_ascii_case("localhost")
        || name.to_ascii_lowercase().ends_with(".localhost")
}

fn is_short_name(name: &str) -> bool {
    !name.is_empty() && name.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'-')
}

#[cfg(test)]
mod tests {
    use super::*;

    fn headers(pairs: &[(HeaderName, &str)]) -> HeaderMap {
        let pair = |(name, value): &(HeaderName, &str)| {
            (name.clone(), HeaderValue::from_str(value).expect("a header"))
        };
        pairs.iter().map(pair).collect()
    }

    #[test]
    fn names_that_a_stranger_can_rebind_are_refused() {
        let check = |access: &Access, host: &str, expected| {
            assert_eq!(access.allows_host(&headers(&[(HOST, host)])), expected, "{host}");
        };
        for host in ["127.0.0.1:8600", "[::1]:8600", "localhost", "LOCALHOST:1", "a.localhost:1"] {
            check(&Access::local(), host, true);
        }
        for host in ["evil.example:8600", "learner:8600", "127.0.0.1.evil.example", ""] {
            check(&Access::local(), host, false);
        }
        check(&Access::anyone(), "learner:8600", true);
        check(&Access::anyone(), "evil.example:8600", false);
        assert!(!Access::local().allows_host(&HeaderMap::new()));
    }

    #[test]
    fn a_token_or_its_cookie_admits() {
        let token = Token::new("0123456789abcdef").expect("a token");
        let access = Access::with_token(token);
        let admits = |name: HeaderName, value: &str| access.admits(&headers(&[(name, value)]));
        assert!(!access.admits(&HeaderMap::new()));
        assert!(admits(AUTHORIZATION, "Bearer 0123456789abcdef"));
        assert!(!admits(AUTHORIZATION, "Bearer 0123456789abcdeF"));
        let cookie = access.cookie_pair();
        assert!(admits(COOKIE, &format!("other=1; {cookie}")));
        assert!(!admits(COOKIE, &cookie[..cookie.len() - 1]));
        assert!(!admits(COOKIE, &format!("{cookie}0")));
        assert!(!access.set_cookie().contains("0123456789abcdef"));
    }

    #[test]
    fn only_the_own_page_can_act() {
        let action = HeaderName::from_static(ACTION_HEADER);
        let check = |pairs: &[(HeaderName, &str)], expected| {
            assert_eq!(is_from_own_page(&headers(pairs)), expected, "{pairs:?}");
        };
        let (host, own) = ((HOST, "127.0.0.1:1"), (ORIGIN, "http://127.0.0.1:1"));
        check(&[host.clone(), own.clone(), (action.clone(), "1")], true);
        check(&[host.clone(), (action.clone(), "1")], true);
        check(&[host.clone(), own], false);
        for origin in ["http://127.0.0.1:2", "http://evil.example", "null"] {
            check(&[host.clone(), (ORIGIN, origin), (action.clone(), "1")], false);
        }
    }
}
