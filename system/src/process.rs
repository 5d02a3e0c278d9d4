//! Processor time, memory and output of processes, from `/proc`.

use std::fs;
use std::str::FromStr;

/// Resources that one or several processes have used since they started.
#[derive(Debug, Clone, Copy, Default)]
pub struct ProcessUsage {
    /// Processor time of all threads, seconds.
    pub cpu_s: f64,
    /// Processor time of the first thread, seconds. In a service, this thread owns the sockets.
    pub first_thread_s: f64,
    /// Bytes written to sockets and files. The system does not count the bytes read from sockets.
    pub written_bytes: f64,
}

impl ProcessUsage {
    /// Returns the usage of the process `pid`; zeros if it has ended.
    #[must_use]
    pub fn of(pid: u32) -> Self {
        let read =
            |path: &str| fs::read_to_string(format!("/proc/{pid}/{path}")).unwrap_or_default();
        Self {
            cpu_s: cpu_s(&read("stat")),
            first_thread_s: cpu_s(&read(&format!("task/{pid}/stat"))),
            written_bytes: value::<u64>(&read("io"), "wchar:") as f64,
        }
    }

    /// Returns the sum over several processes.
    #[must_use]
    pub fn of_all(pids: &[u32]) -> Self {
        pids.iter().map(|pid| Self::of(*pid)).fold(Self::default(), |sum, one| Self {
            cpu_s: sum.cpu_s + one.cpu_s,
            first_thread_s: sum.first_thread_s + one.first_thread_s,
            written_bytes: sum.written_bytes + one.written_bytes,
        })
    }

    /// Returns the usage since the earlier reading `before`.
    #[must_use]
    pub fn since(self, before: Self) -> Self {
        Self {
            cpu_s: self.cpu_s - before.cpu_s,
            first_thread_s: self.first_thread_s - before.first_thread_s,
            written_bytes: self.written_bytes - before.written_bytes,
        }
    }
}

/// Resident memory of a process, KiB. All values are 0 if the process has ended.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct ResidentMemory {
    /// Current value.
    pub current_kib: u64,
    /// Largest value so far.
    pub peak_kib: u64,
}

impl ResidentMemory {
    /// Returns the memory of the process `pid`.
    #[must_use]
    pub fn of(pid: u32) -> Self {
        let status = fs::read_to_string(format!("/proc/{pid}/status")).unwrap_or_default();
        Self { current_kib: value(&status, "VmRSS:"), peak_kib: value(&status, "VmHWM:") }
    }
}

/// Returns the processor time that the whole machine has been busy since it booted, seconds.
#[must_use]
pub fn machine_busy_s() -> f64 {
    let stat = fs::read_to_string("/proc/stat").unwrap_or_default();
    let ticks: Vec<f64> = stat
        .lines()
        .next()
        .unwrap_or_default()
        .split_whitespace()
        .filter_map(|word| word.parse().ok())
        .collect();
    // The columns are user, nice, system, idle, iowait, irq, softirq, steal.
    let busy =
        |(idx, ticks): (usize, &f64)| if matches!(idx, 0..=2 | 5..=7) { *ticks } else { 0.0 };
    ticks.iter().enumerate().map(busy).sum::<f64>() / ticks_per_s()
}

/// Returns the processor time of all children of this process that have ended and were waited for, and of theirs,
/// seconds.
#[must_use]
pub fn ended_children_s() -> f64 {
    let stat = fs::read_to_string("/proc/self/stat").unwrap_or_default();
    // Fields 16 and 17, `cutime` and `cstime`.
    seconds(&stat, 13)
}

/// Sums fields 14 and 15 (`utime`, `stime`).
fn cpu_s(stat: &str) -> f64 {
    seconds(stat, 11)
}

/// Sums two fields, after so many others behind the name. The name may contain anything.
fn seconds(stat: &str, n_before: usize) -> f64 {
    let behind_name = stat.rsplit(')').next().unwrap_or_default();
    let ticks = behind_name.split_whitespace().skip(n_before).take(2);
    ticks.filter_map(|ticks| ticks.parse::<f64>().ok()).sum::<f64>() / ticks_per_s()
}

fn ticks_per_s() -> f64 {
    rustix::param::clock_ticks_per_second() as f64
}

fn value<T: FromStr + Default>(text: &str, key: &str) -> T {
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
        assert_eq!(cpu_s(""), 0.0, "a process that has ended");
    }

    #[test]
    fn this_process_has_used_time_and_memory() {
        let memory = ResidentMemory::of(std::process::id());
        assert!(memory.current_kib > 0 && memory.peak_kib >= memory.current_kib, "{memory:?}");
        assert!(machine_busy_s() > 0.0);
        assert!(ProcessUsage::of(std::process::id()).cpu_s >= 0.0);
    }
}
