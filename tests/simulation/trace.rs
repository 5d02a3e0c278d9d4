//! The trace of a simulation: each message with its fate, the services' log lines and the injected faults, in order.

use std::fmt::{self, Write as _};
use std::fs::File;
use std::hash::{DefaultHasher, Hasher as _};
use std::io::{BufWriter, Write as _};
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};

use tracing::field::{Field, Visit};
use tracing::span::{Attributes, Id, Record};
use tracing::{Event, Level, Metadata, Subscriber};

use crate::system;

/// Number of characters of a field that are written. Longer fields are distinguished by a hash.
const MAX_FIELD_CHARS: usize = 240;

/// True while tracing is suspended.
static IS_PAUSED: AtomicBool = AtomicBool::new(false);

/// Suspends the trace during `work`, for threads of crashed hosts that are still running.
pub(crate) fn without<T>(work: impl FnOnce() -> T) -> T {
    IS_PAUSED.store(true, Ordering::SeqCst);
    let outcome = work();
    IS_PAUSED.store(false, Ordering::SeqCst);
    outcome
}

/// Starts to write the trace of this process to `path`.
pub(crate) fn write_to(path: &Path) {
    let file = BufWriter::new(File::create(path).expect("a file for the trace"));
    let writer = TraceWriter(Mutex::new(State { file, nodes: Vec::new(), node: None }));
    tracing::subscriber::set_global_default(writer).expect("the first subscriber");
}

struct TraceWriter(Mutex<State>);

struct State {
    file: BufWriter<File>,
    /// Hosts by span number, from 1.
    nodes: Vec<String>,
    /// The running host.
    node: Option<usize>,
}

impl TraceWriter {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Subscriber for TraceWriter {
    /// Enables everything in our crates, and only the fate of messages in other libraries.
    fn enabled(&self, metadata: &Metadata<'_>) -> bool {
        if metadata.is_span() {
            return metadata.name() == "node";
        }
        let target = metadata.target();
        target == "turmoil"
            || target.starts_with("simulation")
            || (target.starts_with("tandem") && *metadata.level() <= Level::DEBUG)
    }

    fn new_span(&self, span: &Attributes<'_>) -> Id {
        let mut name = Line::default();
        span.record(&mut name);
        let mut state = self.lock();
        let known = state.nodes.iter().position(|node| *node == name.0);
        let node_idx = known.unwrap_or(state.nodes.len());
        if known.is_none() {
            state.nodes.push(name.0);
        }
        Id::from_u64(node_idx as u64 + 1)
    }

    fn record(&self, _: &Id, _: &Record<'_>) {}

    fn record_follows_from(&self, _: &Id, _: &Id) {}

    fn event(&self, event: &Event<'_>) {
        if IS_PAUSED.load(Ordering::SeqCst) {
            return;
        }
        let mut line = Line::default();
        event.record(&mut line);
        let mut state = self.lock();
        let now = system::now().as_secs_f64();
        let node = state.node.and_then(|node_idx| state.nodes.get(node_idx)).cloned();
        let (node, target) = (node.unwrap_or_default(), event.metadata().target());
        writeln!(state.file, "{now:9.3}{node} {target}{}", line.0).expect("room for the trace");
    }

    fn enter(&self, span: &Id) {
        self.lock().node = usize::try_from(span.into_u64() - 1).ok();
    }

    fn exit(&self, _: &Id) {
        let mut state = self.lock();
        state.node = None;
        // The process may end at any moment.
        state.file.flush().expect("room for the trace");
    }
}

/// The fields of an event with their names.
#[derive(Default)]
struct Line(String);

impl Visit for Line {
    fn record_debug(&mut self, field: &Field, value: &dyn fmt::Debug) {
        let mut text = Shortened::default();
        write!(text, "{value:?}").expect("infallible");
        let Shortened { kept, n_chars, hasher } = text;
        write!(self.0, " {field}={kept}").expect("infallible");
        if n_chars > kept.len() {
            write!(self.0, "… {n_chars} characters, {:016x}", hasher.finish()).expect("infallible");
        }
    }
}

/// The beginning of a text and a hash of the whole text.
#[derive(Default)]
struct Shortened {
    kept: String,
    n_chars: usize,
    hasher: DefaultHasher,
}

impl fmt::Write for Shortened {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        if self.kept.len() < MAX_FIELD_CHARS {
            // Line breaks become spaces.
            self.kept.extend(text.chars().map(|c| if c == '\n' { ' ' } else { c }));
        }
        self.n_chars += text.len();
        self.hasher.write(text.as_bytes());
        Ok(())
    }
}
