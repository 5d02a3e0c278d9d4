//! What happens in a simulation, in order: each message with its fate, what services log, what goes wrong on purpose.

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

/// Characters of a field that are written down; the rest is told apart by its hash.
const MAX_FIELD_CHARS: usize = 240;

/// Whether what happens is not written down.
static IS_PAUSED: AtomicBool = AtomicBool::new(false);

/// Leaves out what happens during `work`: what a crashed host's threads still do, nobody sees.
pub(crate) fn without<T>(work: impl FnOnce() -> T) -> T {
    IS_PAUSED.store(true, Ordering::SeqCst);
    let outcome = work();
    IS_PAUSED.store(false, Ordering::SeqCst);
    outcome
}

/// Writes the trace of this process to `path` from now on.
pub(crate) fn write_to(path: &Path) {
    let file = BufWriter::new(File::create(path).expect("a file for the trace"));
    let writer = TraceWriter(Mutex::new(State { file, nodes: Vec::new(), node: None }));
    tracing::subscriber::set_global_default(writer).expect("the first subscriber");
}

struct TraceWriter(Mutex<State>);

struct State {
    file: BufWriter<File>,
    /// Hosts by the number of their span, from 1.
    nodes: Vec<String>,
    /// The host that runs.
    node: Option<usize>,
}

impl TraceWriter {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Subscriber for TraceWriter {
    /// Of other libraries only what becomes of messages; of ours everything.
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

/// Fields, each with its name.
#[derive(Default)]
struct Line(String);

impl Visit for Line {
    fn record_debug(&mut self, field: &Field, value: &dyn fmt::Debug) {
        let mut text = Shortened::default();
        write!(text, "{value:?}").expect("nothing refuses");
        let Shortened { kept, n_chars, hasher } = text;
        write!(self.0, " {field}={kept}").expect("nothing refuses");
        if n_chars > kept.len() {
            write!(self.0, "… {n_chars} characters, {:016x}", hasher.finish())
                .expect("nothing refuses");
        }
    }
}

/// The beginning of a text and the hash of all of it.
#[derive(Default)]
struct Shortened {
    kept: String,
    n_chars: usize,
    hasher: DefaultHasher,
}

impl fmt::Write for Shortened {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        if self.kept.len() < MAX_FIELD_CHARS {
            // A line stays a line.
            self.kept.extend(text.chars().map(|c| if c == '\n' { ' ' } else { c }));
        }
        self.n_chars += text.len();
        self.hasher.write(text.as_bytes());
        Ok(())
    }
}
