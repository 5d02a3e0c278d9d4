//! What the system knows of a process: its time, its memory, what it wrote.

use std::fs;

/// Processor time, seconds, and bytes written, since a process began.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Spent {
    /// Of all its threads.
    pub(super) cpu_s: f64,
    /// Of its first thread: of the services, the one that has the sockets.
    pub(super) first_thread_s: f64,
    /// What it wrote to sockets and files; what it read from sockets is not counted by the system.
    pub(super) written_bytes: f64,
}

impl Spent {
    /// Of the process with number `pid`; nothing when it is gone.
    pub(super) fn of(pid: u32) -> Self {
        let read =
            |path: &str| fs::read_to_string(format!("/proc/{pid}/{path}")).unwrap_or_default();
        Self {
            cpu_s: cpu_s(&read("stat")),
            first_thread_s: cpu_s(&read(&format!("task/{pid}/stat"))),
            written_bytes: value(&read("io"), "wchar:"),
        }
    }

    /// Of several processes together.
    pub(super) fn of_all(pids: &[u32]) -> Self {
        pids.iter().map(|pid| Self::of(*pid)).fold(Self::default(), |sum, one| Self {
            cpu_s: sum.cpu_s + one.cpu_s,
            first_thread_s: sum.first_thread_s + one.first_thread_s,
            written_bytes: sum.written_bytes + one.written_bytes,
        })
    }

    pub(super) fn since(self, before: Self) -> Self {
        Self {
            cpu_s: self.cpu_s - before.cpu_s,
            first_thread_s: self.first_thread_s - before.first_thread_s,
            written_bytes: self.written_bytes - before.written_bytes,
        }
    }
}

/// Resident memory of a process, MiB: now, and at the most so far.
pub(super) fn resident_mib(pid: u32) -> (f64, f64) {
    let status = fs::read_to_string(format!("/proc/{pid}/status")).unwrap_or_default();
    (value(&status, "VmRSS:") / 1024.0, value(&status, "VmHWM:") / 1024.0)
}

/// Processor seconds that the whole machine was busy since it was started.
pub(super) fn machine_busy_s() -> f64 {
    let stat = fs::read_to_string("/proc/stat").unwrap_or_default();
    let ticks: Vec<f64> = stat
        .lines()
        .next()
        .unwrap_or_default()
        .split_whitespace()
        .filter_map(|word| word.parse().ok())
        .collect();
    // user, nice, system, then idle and waiting for disks, then interrupts and what other guests took.
    let busy =
        |(idx, ticks): (usize, &f64)| if matches!(idx, 0..=2 | 5..=7) { *ticks } else { 0.0 };
    ticks.iter().enumerate().map(busy).sum::<f64>() / ticks_per_s()
}

/// Fields 14 and 15, counted from behind the name, which may hold anything.
fn cpu_s(stat: &str) -> f64 {
    let behind_name = stat.rsplit(')').next().unwrap_or_default();
    let ticks = behind_name.split_whitespace().skip(11).take(2);
    ticks.filter_map(|ticks| ticks.parse::<f64>().ok()).sum::<f64>() / ticks_per_s()
}

fn ticks_per_s() -> f64 {
    rustix::param::clock_ticks_per_second() as f64
}

fn value(text: &str, key: &str) -> f64 {
    let line = text.lines().find_map(|line| line.strip_prefix(key));
    line.and_then(|line| line.split_whitespace().next()?.parse().ok()).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_with_blanks_and_brackets_does_not_shift_the_fields() {
        let fields = "S 1 1 1 0 -1 4194560 100 0 0 0 250 50 0 0 20 0 3 0 100";
        let expected = 300.0 / ticks_per_s();
        for name in ["tandem", "a b", "x) (y"] {
            assert_eq!(cpu_s(&format!("42 ({name}) {fields}")), expected, "{name}");
        }
        assert_eq!(cpu_s(""), 0.0, "a process that is gone");
    }

    #[test]
    fn this_process_has_used_time_and_memory() {
        let (now, most) = resident_mib(std::process::id());
        assert!(now > 0.0 && most >= now, "{now} {most}");
        assert!(machine_busy_s() > 0.0);
        assert!(Spent::of(std::process::id()).cpu_s >= 0.0);
    }
}
