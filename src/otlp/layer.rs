//! From spans of `tracing` to spans of OpenTelemetry.

use std::fmt;
use std::time::{Duration, Instant};

use opentelemetry_proto::tonic::common::v1::any_value::Value;
use opentelemetry_proto::tonic::common::v1::{AnyValue, KeyValue};
use opentelemetry_proto::tonic::trace::v1::Span;
use opentelemetry_proto::tonic::trace::v1::span::SpanKind;
use tokio::sync::mpsc;
use tracing::field::{Field, Visit};
use tracing::span::{Attributes, Id, Record};
use tracing::{Metadata, Subscriber};
use tracing_subscriber::Layer;
use tracing_subscriber::layer::Context;
use tracing_subscriber::registry::LookupSpan;

use crate::clock;

/// Passes the spans that have a trace context to the exporter once they are closed.
pub(crate) struct SpanLayer {
    spans: mpsc::Sender<Span>,
}

/// A span that is not closed yet.
struct OpenSpan {
    span: Span,
    /// Measures the duration of the span, because the time of day may be set meanwhile.
    start: Instant,
}

impl SpanLayer {
    pub(super) const fn new(spans: mpsc::Sender<Span>) -> Self {
        Self { spans }
    }

    /// Returns true if a span has a trace context.
    pub(crate) fn wants(metadata: &Metadata<'_>) -> bool {
        metadata.is_span() && metadata.fields().field("trace_id").is_some()
    }
}

impl<S: Subscriber + for<'a> LookupSpan<'a>> Layer<S> for SpanLayer {
    fn on_new_span(&self, attributes: &Attributes<'_>, id: &Id, context: Context<'_, S>) {
        let mut fields = Fields::default();
        attributes.record(&mut fields);
        if let Some(context) = context.span(id) {
            let span = Span { start_time_unix_nano: clock::unix_nanos(), ..fields.span };
            context.extensions_mut().insert(OpenSpan { span, start: clock::now() });
        }
    }

    fn on_record(&self, id: &Id, values: &Record<'_>, context: Context<'_, S>) {
        let mut fields = Fields::default();
        values.record(&mut fields);
        if let Some(span) = context.span(id)
            && let Some(open) = span.extensions_mut().get_mut::<OpenSpan>()
        {
            open.span.attributes.append(&mut fields.span.attributes);
        }
    }

    fn on_close(&self, id: Id, context: Context<'_, S>) {
        let Some(span) = context.span(&id) else { return };
        let Some(open) = span.extensions_mut().remove::<OpenSpan>() else { return };
        // Fails if the collector is away or too slow.
        drop(self.spans.try_send(closed_after(open.start.elapsed(), open.span)));
    }
}

/// Returns `span` with the end that it has after `duration`.
fn closed_after(duration: Duration, span: Span) -> Span {
    let n_nanos = u64::try_from(duration.as_nanos()).unwrap_or(u64::MAX);
    let end_time_unix_nano = span.start_time_unix_nano.saturating_add(n_nanos);
    Span { end_time_unix_nano, ..span }
}

/// The fields of a span.
#[derive(Default)]
struct Fields {
    span: Span,
}

impl Fields {
    fn record(&mut self, field: &Field, value: String) {
        match field.name() {
            "trace_id" => self.span.trace_id = bytes_of(&value),
            "span_id" => self.span.span_id = bytes_of(&value),
            "parent_span_id" => self.span.parent_span_id = bytes_of(&value),
            "otel.name" => self.span.name = value,
            "otel.kind" => self.span.kind = kind_of(&value) as i32,
            name => self.span.attributes.push(KeyValue {
                key: name.to_owned(),
                value: Some(text(value)),
                ..KeyValue::default()
            }),
        }
    }
}

impl Visit for Fields {
    fn record_str(&mut self, field: &Field, value: &str) {
        self.record(field, value.to_owned());
    }

    fn record_debug(&mut self, field: &Field, value: &dyn fmt::Debug) {
        self.record(field, format!("{value:?}"));
    }
}

/// Returns the bytes of hexadecimal digits.
fn bytes_of(digits: &str) -> Vec<u8> {
    let pairs = digits.as_bytes().chunks_exact(2).filter_map(|pair| std::str::from_utf8(pair).ok());
    pairs.filter_map(|pair| u8::from_str_radix(pair, 16).ok()).collect()
}

fn kind_of(name: &str) -> SpanKind {
    match name {
        "client" => SpanKind::Client,
        "server" => SpanKind::Server,
        _ => SpanKind::Internal,
    }
}

/// Returns a value that is a text.
pub(super) const fn text(text: String) -> AnyValue {
    AnyValue { value: Some(Value::StringValue(text)) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_span_ends_its_duration_after_its_start() {
        let open = Span { start_time_unix_nano: 5_000_000_000, ..Span::default() };
        let closed = closed_after(Duration::from_millis(3), open);
        assert_eq!(closed.end_time_unix_nano, 5_003_000_000);
    }
}
