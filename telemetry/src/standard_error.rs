//! Lines for standard error, written by a separate thread.
//!
//! Standard error may be a file on a full disk, or a pipe whose reader has stopped. Neither ends the process or blocks
//! a thread that logs. Lines that cannot be written are dropped and counted; once writing works again, a line with the
//! count replaces them.

use std::io::{self, ErrorKind, Write};
use std::sync::{Arc, Condvar, LazyLock, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::Duration;

/// Maximum number of bytes in the queue. Lines that do not fit are dropped.
const CAPACITY: usize = 4 << 20;

static STANDARD_ERROR: LazyLock<LineQueue> = LazyLock::new(|| LineQueue::new(io::stderr()));

/// Queues `line` for standard error, without blocking.
pub fn write_line(line: &str) {
    STANDARD_ERROR.push(format!("{line}\n").as_bytes());
}

/// Waits until all queued lines are written or dropped, or until `timeout` has passed. For the end of a process.
pub fn flush(timeout: Duration) {
    STANDARD_ERROR.flush(timeout);
}

/// A writer to standard error for `tracing`. Each write is one event and never fails.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct EventWriter;

impl Write for EventWriter {
    fn write(&mut self, event: &[u8]) -> io::Result<usize> {
        STANDARD_ERROR.push(event);
        Ok(event.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// A queue of lines for a writer that may fail or block.
struct LineQueue(Arc<Shared>);

#[derive(Default)]
struct Shared {
    queue: Mutex<Queue>,
    changed: Condvar,
}

#[derive(Default)]
struct Queue {
    /// Complete lines.
    bytes: Vec<u8>,
    is_writing: bool,
    /// Number of lines that did not fit since the queue was last emptied.
    n_dropped: usize,
}

impl LineQueue {
    fn new(writer: impl Write + Send + 'static) -> Self {
        let shared = Arc::new(Shared::default());
        let thread_shared = Arc::clone(&shared);
        let name = "standard error".to_owned();
        // If the thread cannot be started, lines fill the queue and are dropped.
        drop(thread::Builder::new().name(name).spawn(move || thread_shared.write_to(writer)));
        Self(shared)
    }

    fn push(&self, lines: &[u8]) {
        let mut queue = self.0.lock();
        if queue.bytes.len() + lines.len() > CAPACITY {
            queue.n_dropped += n_lines(lines);
        } else {
            queue.bytes.extend_from_slice(lines);
            self.0.changed.notify_all();
        }
    }

    fn flush(&self, timeout: Duration) {
        let is_busy = |queue: &mut Queue| queue.is_writing || !queue.bytes.is_empty();
        drop(self.0.changed.wait_timeout_while(self.0.lock(), timeout, is_busy));
    }
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, Queue> {
        self.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Writes queued lines until the process ends.
    fn write_to(&self, mut writer: impl Write) {
        let mut ends_within_a_line = false;
        let mut n_failed = 0;
        loop {
            let is_empty = |queue: &mut Queue| queue.bytes.is_empty();
            let waited = self.changed.wait_while(self.lock(), is_empty);
            let mut queue = waited.unwrap_or_else(PoisonError::into_inner);
            let lines = std::mem::take(&mut queue.bytes);
            // These lines found the queue full, so they are newer than the lines in it.
            let n_after = std::mem::take(&mut queue.n_dropped);
            queue.is_writing = true;
            drop(queue);

            let end_of_line = if ends_within_a_line { "\n" } else { "" };
            let before = format!("{end_of_line}{}", notice(n_failed));
            let bytes = [before.as_bytes(), &lines, notice(n_after).as_bytes()].concat();
            let n_written = write_up_to_an_error(&mut writer, &bytes);
            if let Some(last) = bytes[..n_written].last() {
                ends_within_a_line = *last != b'\n';
            }
            let n_failed_before = if n_written < before.len() { n_failed } else { 0 };
            let unwritten = lines.get(n_written.saturating_sub(before.len())..).unwrap_or_default();
            let n_after = if n_written < bytes.len() { n_after } else { 0 };
            n_failed = n_failed_before + n_lines(unwritten) + n_after;

            self.lock().is_writing = false;
            self.changed.notify_all();
        }
    }
}

/// Returns a line with the number of missing lines, or nothing if none is missing.
fn notice(n_missing: usize) -> String {
    match n_missing {
        0 => String::new(),
        n => format!("tandem: {n} lines could not be written here\n"),
    }
}

/// Writes `bytes` until the writer fails, and returns the number of bytes written.
fn write_up_to_an_error(writer: &mut impl Write, bytes: &[u8]) -> usize {
    let mut n_written = 0;
    while n_written < bytes.len() {
        match writer.write(&bytes[n_written..]) {
            Ok(0) => break,
            Ok(n) => n_written += n,
            Err(error) if error.kind() == ErrorKind::Interrupted => {}
            Err(_) => break,
        }
    }
    n_written
}

fn n_lines(bytes: &[u8]) -> usize {
    bytes.iter().filter(|byte| **byte == b'\n').count()
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc::{Receiver, SyncSender, sync_channel};

    use super::*;

    const TIMEOUT: Duration = Duration::from_secs(30);

    /// A writer with limited space. It fails once the space is used up.
    #[derive(Clone, Default)]
    struct Disk(Arc<Mutex<(usize, Vec<u8>)>>);

    impl Disk {
        fn set_space(&self, n_bytes: usize) {
            self.0.lock().unwrap().0 = n_bytes;
        }

        fn text(&self) -> String {
            String::from_utf8(self.0.lock().unwrap().1.clone()).unwrap()
        }
    }

    impl Write for Disk {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            let mut disk = self.0.lock().unwrap();
            let n = bytes.len().min(disk.0);
            if n == 0 {
                return Err(ErrorKind::StorageFull.into());
            }
            disk.0 -= n;
            disk.1.extend_from_slice(&bytes[..n]);
            Ok(n)
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn dropped_lines_are_counted_once_there_is_space_again() {
        let disk = Disk::default();
        let lines = LineQueue::new(disk.clone());
        let log = |line: &str| {
            lines.push(format!("{line}\n").as_bytes());
            lines.flush(TIMEOUT);
        };
        disk.set_space(9);
        ["one", "two-and-a-half", "three", "four"].iter().for_each(|line| log(line));
        disk.set_space(1000);
        ["five", "six"].iter().for_each(|line| log(line));
        let expected = "one\ntwo-a\ntandem: 3 lines could not be written here\nfive\nsix\n";
        assert_eq!(disk.text(), expected);
    }

    #[test]
    fn an_incomplete_count_is_repeated() {
        let disk = Disk::default();
        let lines = LineQueue::new(disk.clone());
        for (n_bytes, line) in [(0, "one\n"), (5, "two\n"), (1000, "three\n")] {
            disk.set_space(n_bytes);
            lines.push(line.as_bytes());
            lines.flush(TIMEOUT);
        }
        let expected = "tande\ntandem: 2 lines could not be written here\nthree\n";
        assert_eq!(disk.text(), expected);
    }

    /// A pipe whose reader blocks until the channel is closed.
    struct BlockedPipe(Receiver<()>, Disk);

    impl Write for BlockedPipe {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            self.0.recv().ok();
            self.1.write(bytes)
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn a_blocked_writer_blocks_no_caller() {
        let disk = Disk::default();
        disk.set_space(usize::MAX);
        let (unblock, unblocked): (SyncSender<()>, _) = sync_channel(0);
        let lines = LineQueue::new(BlockedPipe(unblocked, disk.clone()));
        let line = [&[b'x'; 1023][..], b"\n"].concat();
        (0..10_000).for_each(|_| lines.push(&line));
        lines.flush(Duration::from_millis(1));
        drop(unblock);
        lines.flush(TIMEOUT);
        lines.push(b"last\n");
        lines.flush(TIMEOUT);
        let text = disk.text();
        let n_missing = |line: &str| -> Option<usize> {
            line.strip_prefix("tandem: ")?
                .strip_suffix(" lines could not be written here")?
                .parse()
                .ok()
        };
        let (notices, written): (Vec<_>, Vec<_>) =
            text.lines().map(n_missing).partition(Option::is_some);
        let n_missing: usize = notices.into_iter().flatten().sum();
        assert!(n_missing > 1000, "{n_missing}");
        assert_eq!(n_missing + written.len(), 10_001, "every line is written or counted");
        assert!(text.ends_with("x\nlast\n") || text.ends_with("here\nlast\n"));
    }
}
