//! Simulated replacements of the operating system's clocks and random numbers, which libraries use for the keys of hash
//! maps, for tokio's `select!` and for dates in HTTP headers.
//!
//! The functions here override functions of the C library, as the crate `mad-turmoil` does. That crate would also stop
//! the clocks of the processes that only start simulations, whose test harness would then wait in a busy loop.
#![expect(unsafe_code, reason = "the replaced functions get pointers from C")]

use std::cell::Cell;
use std::ffi::{c_int, c_long, c_uint};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use libc::{CLOCK_PROCESS_CPUTIME_ID, CLOCK_THREAD_CPUTIME_ID, clockid_t, timespec};

/// True if random numbers are simulated in this process.
static IS_SIMULATED: AtomicBool = AtomicBool::new(false);
/// State of the random number generator.
static RANDOM: AtomicU64 = AtomicU64::new(0);
/// Simulated time, nanoseconds.
static NOW: AtomicU64 = AtomicU64::new(0);

thread_local! {
    /// True if clocks show simulated time on this thread. The test harness measures real time on another thread.
    static HAS_SIMULATED_CLOCKS: Cell<bool> = const { Cell::new(false) };
}

/// Switches the clocks of the calling thread to the time set by [`set_now`], and the random numbers of this process to
/// those generated from `seed`.
pub(crate) fn simulate(seed: u64) {
    RANDOM.store(seed, Ordering::SeqCst);
    IS_SIMULATED.store(true, Ordering::SeqCst);
    HAS_SIMULATED_CLOCKS.set(true);
}

/// Sets the time since the beginning of the simulation.
pub(crate) fn set_now(now: Duration) {
    NOW.store(u64::try_from(now.as_nanos()).expect("an hour at most"), Ordering::SeqCst);
}

/// Returns the time since the beginning of the simulation.
pub(crate) fn now() -> Duration {
    Duration::from_nanos(NOW.load(Ordering::SeqCst))
}

/// Returns the next output of SplitMix64.
fn random() -> u64 {
    const STEP: u64 = 0x9e37_79b9_7f4a_7c15;
    let state = RANDOM.fetch_add(STEP, Ordering::SeqCst).wrapping_add(STEP);
    let mixed = (state ^ (state >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    mixed ^ (mixed >> 31)
}

// SAFETY: has the signature of the function that it replaces.
#[unsafe(no_mangle)]
unsafe extern "C" fn getrandom(buffer: *mut u8, n_bytes: usize, flags: c_uint) -> isize {
    if !IS_SIMULATED.load(Ordering::SeqCst) {
        // SAFETY: the arguments are passed on unchanged.
        let n_read = unsafe { libc::syscall(libc::SYS_getrandom, buffer, n_bytes, flags) };
        return isize::try_from(n_read).unwrap_or(-1);
    }
    for byte_idx in 0..n_bytes {
        // SAFETY: the caller provides a buffer of this size.
        unsafe { buffer.add(byte_idx).write(random().to_le_bytes()[0]) };
    }
    isize::try_from(n_bytes).unwrap_or(-1)
}

// SAFETY: has the signature of the function that it replaces.
#[unsafe(no_mangle)]
unsafe extern "C" fn clock_gettime(clock: clockid_t, time: *mut timespec) -> c_int {
    let measures_work = [CLOCK_PROCESS_CPUTIME_ID, CLOCK_THREAD_CPUTIME_ID].contains(&clock);
    if measures_work || !HAS_SIMULATED_CLOCKS.get() {
        // SAFETY: the arguments are passed on unchanged.
        let outcome = unsafe { libc::syscall(libc::SYS_clock_gettime, clock, time) };
        return c_int::try_from(outcome).unwrap_or(-1);
    }
    let now = now();
    let seconds = libc::time_t::try_from(now.as_secs()).unwrap_or(libc::time_t::MAX);
    let value = timespec { tv_sec: seconds, tv_nsec: c_long::from(now.subsec_nanos()) };
    // SAFETY: the caller provides a valid pointer.
    unsafe { time.write(value) };
    0
}
