//! Lines for standard error, written by a thread of its own.
//!
//! Standard error may be a file on a full disk, or a pipe whose reader has stopped reading. Neither may end the process
//! or hold up a thread that has something to say. Lines that cannot be written are dropped and counted; a line with
//! the count takes their place once writing works again.

use std::io::{self, ErrorKind, Write};
use std::sync::{Arc, Condvar, LazyLock, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::Duration;

/// Bytes that wait to be written at most. Lines that find no room are dropped.
const CAPACITY: usize = 4 << 20;

static STANDARD_ERROR: LazyLock<Lines> = LazyLock::new(|| Lines::to(io::stderr()));

/// Adds `line` to what is written to standard error, without waiting.
pub fn write_line(line: &str) {
    STANDARD_ERROR.push(format!("{line}\n").as_bytes());
}

/// Waits until all lines are written or dropped, at most for `patience`. For the end of a process.
pub fn flush(patience: Duration) {
    STANDARD_ERROR.flush(patience);
}

/// Standard error for `tracing`: every write is one whole event and never fails.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Events;

impl Write for Events {
    fn write(&mut self, event: &[u8]) -> io::Result<usize> {
        STANDARD_ERROR.push(event);
        Ok(event.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// Lines on their way to a writer that may fail or never return.
struct Lines(Arc<Shared>);

#[derive(Default)]
struct Shared {
    queue: Mutex<Queue>,
    changed: Condvar,
}

#[derive(Default)]
struct Queue {
    /// Whole lines.
    bytes: Vec<u8>,
    is_writing: bool,
    /// Lines that found no room since the others were taken out.
    n_dropped: usize,
}

impl Lines {
    fn to(writer: impl Write + Send + 'static) -> Self {
        let shared = Arc::new(Shared::default());
        let theirs = Arc::clone(&shared);
        let name = "standard error".to_owned();
        // Without the thread, lines fill the queue and are dropped: the work goes on.
        drop(thread::Builder::new().name(name).spawn(move || theirs.write_to(writer)));
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

    fn flush(&self, patience: Duration) {
        let is_busy = |queue: &mut Queue| queue.is_writing || !queue.bytes.is_empty();
        drop(self.0.changed.wait_timeout_while(self.0.lock(), patience, is_busy));
    }
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, Queue> {
        self.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Writes what is pushed, for ever.
    fn write_to(&self, mut writer: impl Write) {
        let mut ends_within_a_line = false;
        let mut n_failed = 0;
        loop {
            let is_empty = |queue: &mut Queue| queue.bytes.is_empty();
            let waited = self.changed.wait_while(self.lock(), is_empty);
            let mut queue = waited.unwrap_or_else(PoisonError::into_inner);
            let lines = std::mem::take(&mut queue.bytes);
            // They found the queue full, so they came after the lines that are in it.
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

/// Says that lines are missing, where some are.
fn notice(n_missing: usize) -> String {
    match n_missing {
        0 => String::new(),
        n => format!("tandem: {n} lines could not be written here\n"),
    }
}

/// How many of `bytes` were written before the writer failed.
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

    const PATIENCE: Duration = Duration::from_secs(30);

    /// Takes `room` bytes and then fails, until it is given more.
    #[derive(Clone, Default)]
    struct Disk(Arc<Mutex<(usize, Vec<u8>)>>);

    impl Disk {
        fn give(&self, room: usize) {
            self.0.lock().unwrap().0 = room;
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
    fn lines_that_find_no_room_are_counted_once_there_is_room_again() {
        let disk = Disk::default();
        let lines = Lines::to(disk.clone());
        let say = |line: &str| {
            lines.push(format!("{line}\n").as_bytes());
            lines.flush(PATIENCE);
        };
        disk.give(9);
        ["one", "two-and-a-half", "three", "four"].iter().for_each(|line| say(line));
        disk.give(1000);
        ["five", "six"].iter().for_each(|line| say(line));
        let expected = "one\ntwo-a\ntandem: 3 lines could not be written here\nfive\nsix\n";
        assert_eq!(disk.text(), expected);
    }

    #[test]
    fn a_count_that_is_cut_short_is_given_again() {
        let disk = Disk::default();
        let lines = Lines::to(disk.clone());
        for (room, line) in [(0, "one\n"), (5, "two\n"), (1000, "three\n")] {
            disk.give(room);
            lines.push(line.as_bytes());
            lines.flush(PATIENCE);
        }
        let expected = "tande\ntandem: 2 lines could not be written here\nthree\n";
        assert_eq!(disk.text(), expected);
    }

    /// A pipe whose reader does not read before it is told to.
    struct Stuck(Receiver<()>, Disk);

    impl Write for Stuck {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            self.0.recv().ok();
            self.1.write(bytes)
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn a_writer_that_is_stuck_holds_nobody_up() {
        let disk = Disk::default();
        disk.give(usize::MAX);
        let (go_on, is_to_go_on): (SyncSender<()>, _) = sync_channel(0);
        let lines = Lines::to(Stuck(is_to_go_on, disk.clone()));
        let line = [&[b'x'; 1023][..], b"\n"].concat();
        (0..10_000).for_each(|_| lines.push(&line));
        lines.flush(Duration::from_millis(1));
        drop(go_on);
        lines.flush(PATIENCE);
        lines.push(b"last\n");
        lines.flush(PATIENCE);
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
        assert_eq!(n_missing + written.len(), 10_001, "all are written or counted");
        assert!(text.ends_with("x\nlast\n") || text.ends_with("here\nlast\n"));
    }
}
