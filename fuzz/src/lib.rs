//! Shared parts of the fuzz targets: a memory bound, a scratch file, and mutations that keep a file's framing valid.
//!
//! Decoders check lengths and checksums first. Random changes rarely get past those, so [`safetensors_file`] and
//! [`mcap_file`] mutate a part of a file and then recompute its lengths and checksums.

pub mod mcap_file;
pub mod safetensors_file;
pub mod sample;

use std::alloc::System;
use std::panic;
use std::path::{Path, PathBuf};
use std::sync::{Once, OnceLock};

use cap::Cap;
use tempfile::TempDir;

#[global_allocator]
static ALLOCATOR: Cap<System> = Cap::new(System, usize::MAX);

/// Memory that decoding one input may take. Inputs have at most 64 KiB: a decoder that needs more than a thousand
/// times that believes a length that the input declares.
const MAX_BYTES: usize = 64 << 20;

/// Mutates `data[..size]` in place as libFuzzer does by default and returns the new size, at most `max_size`.
pub type Mutate = fn(data: &mut [u8], size: usize, max_size: usize) -> usize;

/// Runs `decode`, which aborts the process when it takes more than 64 MiB.
pub fn with_bounded_memory<T>(decode: impl FnOnce() -> T) -> T {
    static HOOK: Once = Once::new();
    HOOK.call_once(lift_limit_on_panic);
    let limit = ALLOCATOR.allocated() + MAX_BYTES;
    ALLOCATOR.set_limit(limit).expect("the limit exceeds the allocated memory");
    let decoded = decode();
    ALLOCATOR.set_limit(usize::MAX).expect("no limit is too low");
    decoded
}

/// Lets a panic take the memory that its backtrace needs.
fn lift_limit_on_panic() {
    let hook = panic::take_hook();
    panic::set_hook(Box::new(move |info| {
        ALLOCATOR.set_limit(usize::MAX).expect("no limit is too low");
        hook(info);
    }));
}

/// Returns the path of this process's scratch file `name`.
pub fn scratch_file(name: &str) -> PathBuf {
    static DIRECTORY: OnceLock<TempDir> = OnceLock::new();
    let directory = DIRECTORY.get_or_init(|| tempfile::tempdir().expect("a temporary directory"));
    directory.path().join(name)
}

/// Writes `bytes` to the file `path`.
pub fn write(path: &Path, bytes: &[u8]) {
    std::fs::write(path, bytes).expect("the scratch file can be written");
}

/// Mutates the part `data[range]` with `mutate`, which may change its length, and returns the whole.
fn mutate_part(
    data: &[u8],
    range: std::ops::Range<usize>,
    max_size: usize,
    mutate: Mutate,
) -> Vec<u8> {
    let rest = data.len() - range.len();
    let most = max_size.saturating_sub(rest).max(range.len());
    let mut part = data[range.clone()].to_vec();
    part.resize(most, 0);
    let n = mutate(&mut part, range.len(), most);
    [&data[..range.start], &part[..n], &data[range.end..]].concat()
}
