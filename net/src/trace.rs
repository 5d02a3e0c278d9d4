//! The trace context of calls, as the W3C recommendation "Trace Context" defines it.
//!
//! A trace is the life of a slot: its rollout, its requests for advice and its submission. Its numbers are derived from
//! what the slot is, so they repeat with the run and no random number is drawn.

use std::fmt;
use std::str::FromStr;

use http::HeaderMap;
use http::header::{HeaderName, HeaderValue};
use tracing::Span;

/// The header of a call that has a trace context.
const TRACEPARENT: HeaderName = HeaderName::from_static("traceparent");

/// A span of a trace. Neither number is zero.
///
/// A client sends it with a call by adding it to the extensions of the request, and a service finds the span of the
/// call itself there. Its text is the value of the header `traceparent`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TraceContext {
    trace_id: u128,
    span_id: u64,
}

/// The error of a text that is not a trace context.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error(
    "expected a trace context, such as 00-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01"
)]
pub struct InvalidTraceContext;

impl TraceContext {
    /// Returns the first span of the trace that `parts` identify.
    #[must_use]
    pub fn of(parts: &[u64]) -> Self {
        let half = |salt| parts.iter().fold(salt, |state, part| mix(state ^ mix(*part)));
        let trace_id = u128::from(half(1)) << 64 | u128::from(half(2));
        Self { trace_id: trace_id.max(1), span_id: half(3).max(1) }
    }

    /// Returns the span number `number` of the kind `name` within this span.
    #[must_use]
    pub fn child(self, name: &str, number: u64) -> Self {
        let named = name.bytes().fold(self.span_id, |state, byte| mix(state ^ u64::from(byte)));
        Self { span_id: mix(named ^ mix(number)).max(1), ..self }
    }

    /// Returns the trace context in the headers of a request, if there is a valid one.
    pub(crate) fn from_headers(headers: &HeaderMap) -> Option<Self> {
        headers.get(TRACEPARENT)?.to_str().ok()?.parse().ok()
    }

    /// Adds the trace context to the headers of a request.
    pub(crate) fn add_to(self, headers: &mut HeaderMap) {
        if let Ok(value) = HeaderValue::try_from(self.to_string()) {
            headers.insert(TRACEPARENT, value);
        }
    }

    /// Returns a span of level `debug` for log lines and exporters, with the fields `trace_id`, `span_id`,
    /// `parent_span_id`, `otel.name` and `otel.kind`.
    ///
    /// The span is one of `parent`; `None` for the first span of a trace. `kind` is `client`, `server` or `internal`.
    #[must_use]
    pub fn span(self, parent: Option<Self>, name: &str, kind: &str) -> Span {
        let parent = parent.map(|parent| format!("{:016x}", parent.span_id));
        tracing::debug_span!(
            "trace",
            otel.name = name,
            otel.kind = kind,
            trace_id = %format_args!("{:032x}", self.trace_id),
            span_id = %format_args!("{:016x}", self.span_id),
            parent_span_id = parent,
        )
    }
}

impl fmt::Display for TraceContext {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "00-{:032x}-{:016x}-01", self.trace_id, self.span_id)
    }
}

impl FromStr for TraceContext {
    type Err = InvalidTraceContext;

    fn from_str(text: &str) -> Result<Self, InvalidTraceContext> {
        parse(text).ok_or(InvalidTraceContext)
    }
}

/// Parses a text of version 00, or the first fields of a later version.
fn parse(text: &str) -> Option<TraceContext> {
    let mut fields = text.split('-');
    let version = hexadecimal(fields.next()?, 2)?;
    let trace_id = hexadecimal(fields.next()?, 32).filter(|id| *id != 0)?;
    let span_id = u64::try_from(hexadecimal(fields.next()?, 16)?).ok().filter(|id| *id != 0)?;
    hexadecimal(fields.next()?, 2)?;
    let has_more = fields.next().is_some();
    let is_known = version != 0xff && (version != 0 || !has_more);
    is_known.then_some(TraceContext { trace_id, span_id })
}

/// Parses exactly `n_digits` lower-case hexadecimal digits.
fn hexadecimal(text: &str, n_digits: usize) -> Option<u128> {
    let is_digit = |byte: u8| matches!(byte, b'0'..=b'9' | b'a'..=b'f');
    let is_valid = text.len() == n_digits && text.bytes().all(is_digit);
    is_valid.then(|| u128::from_str_radix(text, 16).ok()).flatten()
}

/// Mixes the bits of a number (SplitMix64).
const fn mix(number: u64) -> u64 {
    let mut mixed = number.wrapping_add(0x9e37_79b9_7f4a_7c15);
    mixed = (mixed ^ (mixed >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    mixed ^ (mixed >> 31)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    #[test]
    fn a_context_is_parsed_as_it_is_written() {
        let context = TraceContext::of(&[7, 3]).child("advise", 4);
        assert_eq!(context.to_string().parse(), Ok(context));
        assert_eq!(context.to_string().len(), 55);
    }

    #[test]
    fn texts_that_the_recommendation_rejects_are_rejected() {
        let valid = "00-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01";
        assert!(valid.parse::<TraceContext>().is_ok());
        assert!(format!("01{}-later", &valid[2..]).parse::<TraceContext>().is_ok());
        for invalid in [
            String::new(),
            valid[..54].to_owned(),
            format!("{valid}-more"),
            format!("ff{}", &valid[2..]),
            valid.to_uppercase(),
            "00-00000000000000000000000000000000-00f067aa0ba902b7-01".to_owned(),
            "00-4bf92f3577b34da6a3ce929d0e0e4736-0000000000000000-01".to_owned(),
            "00-+bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01".to_owned(),
        ] {
            assert_eq!(invalid.parse::<TraceContext>(), Err(InvalidTraceContext), "{invalid:?}");
        }
    }

    #[test]
    fn spans_of_a_trace_differ_and_repeat() {
        let slots: Vec<TraceContext> =
            (0..50).flat_map(|seed| (0..50).map(move |n| TraceContext::of(&[seed, n]))).collect();
        let traces: BTreeSet<u128> = slots.iter().map(|slot| slot.trace_id).collect();
        assert_eq!(traces.len(), slots.len());
        let steps: BTreeSet<u64> = slots
            .iter()
            .take(50)
            .flat_map(|slot| (0..50).map(|step| slot.child("advise", step).span_id))
            .collect();
        assert_eq!(steps.len(), 2500);
        assert_eq!(slots[7].child("advise", 3), slots[7].child("advise", 3));
        assert_ne!(slots[7].child("advise", 3), slots[7].child("submit", 3));
    }
}
