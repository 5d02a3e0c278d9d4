//! A preloaded shared object that makes the files below one directory fail on demand.
//!
//! `device.rs` compiles it with `rustc` and describes the fault in the environment:
//!
//! - `FAULTY_DISK_ROOT`: the directory. Files elsewhere are not touched.
//! - `FAULTY_DISK_STATE`: a directory with the file `counters`, which all processes share, and the file `calls`, to
//!   which each call is appended as a line. With the fault `cut` it also receives copies of synced files, named by inode.
//! - `FAULTY_DISK_FAULT`: `MODE ERRNO N PATTERN`. The fault hits the `N`th call, from 1, whose line in `calls` contains
//!   `PATTERN`. Unset: calls are only counted. A line is the name of the function without a `64` at its end, and the path
//!   below the directory with `#` for every number.
//!
//! An affected write writes the first half of its bytes. Any other affected call does nothing.
//!
//! This file is not a module of the test: it is compiled separately and uses only the standard library.

use std::ffi::{CStr, OsStr, c_char, c_int, c_uint, c_void};
use std::fs::{File, OpenOptions};
use std::io::Write as _;
use std::os::fd::AsRawFd as _;
use std::os::unix::ffi::OsStrExt as _;
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};
use std::ptr::null_mut;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicPtr, AtomicU64, Ordering};

const ENOSYS: c_int = 38;
const SIGKILL: c_int = 9;
const AT_FDCWD: c_int = -100;
const O_CREAT: c_int = 0o100;
const O_TRUNC: c_int = 0o1000;
const RTLD_NEXT: *mut c_void = usize::MAX as *mut c_void;

unsafe extern "C" {
    fn dlsym(handle: *mut c_void, name: *const c_char) -> *mut c_void;
    fn mmap(
        at: *mut c_void,
        n: usize,
        protection: c_int,
        flags: c_int,
        fd: c_int,
        offset: i64,
    ) -> *mut c_void;
    fn __errno_location() -> *mut c_int;
    fn kill(pid: c_int, signal: c_int) -> c_int;
}

/// The effect of the fault.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Mode {
    /// The call fails. Later calls succeed.
    Once,
    /// The call and all later calls fail.
    Dead,
    /// The process that makes the call is killed.
    Kill,
    /// The process that makes the call is killed, as is every process that makes a later call.
    Cut,
}

struct Fault {
    mode: Mode,
    errno: c_int,
    at: u64,
    pattern: String,
}

/// Shared by all processes.
#[repr(C)]
struct Counters {
    /// Number of calls that match the fault's pattern, or of all calls if there is no fault.
    n_matching: AtomicU64,
    /// 1 once the fault has been triggered.
    is_hit: AtomicU64,
}

struct Disk {
    root: PathBuf,
    state: PathBuf,
    calls: File,
    counters: &'static Counters,
    fault: Option<Fault>,
}

/// The outcome of one call.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Fate {
    Passes,
    /// Fails with the error number. A write first writes half of its bytes.
    Tears(c_int),
    /// Fails with the error number and does nothing.
    Fails(c_int),
    /// Kills the process. A write first writes half of its bytes.
    Kills,
}

static DISK: OnceLock<Disk> = OnceLock::new();

#[used]
#[unsafe(link_section = ".init_array")]
static START: extern "C" fn() = start;

/// Reads the environment before the program's `main`. Until then every call passes.
extern "C" fn start() {
    let variable = |name| std::env::var_os(name);
    let (Some(root), Some(state)) = (variable("FAULTY_DISK_ROOT"), variable("FAULTY_DISK_STATE"))
    else {
        return;
    };
    let fault = variable("FAULTY_DISK_FAULT").map(|text| fault(text.to_str().expect("UTF-8")));
    let state = PathBuf::from(state);
    let calls =
        OpenOptions::new().append(true).create(true).open(state.join("calls")).expect("opens");
    let counters =
        OpenOptions::new().read(true).write(true).open(state.join("counters")).expect("opens");
    // SAFETY: the file has a page of zeros and stays mapped until the process ends.
    let page = unsafe { mmap(null_mut(), 4096, 3, 1, counters.as_raw_fd(), 0) };
    // SAFETY: the page is large enough, aligned, and accessed by atomic operations only.
    let counters = unsafe { &*page.cast::<Counters>() };
    drop(DISK.set(Disk { root: root.into(), state, calls, counters, fault }));
}

fn fault(text: &str) -> Fault {
    let mut words = text.splitn(4, ' ');
    let mut word = || words.next().expect("four words");
    let mode = match word() {
        "once" => Mode::Once,
        "dead" => Mode::Dead,
        "kill" => Mode::Kill,
        _ => Mode::Cut,
    };
    let errno = word().parse().expect("a number");
    Fault { mode, errno, at: word().parse().expect("a number"), pattern: word().to_owned() }
}

impl Disk {
    /// Decides the fate of the call `name` on `path`, which may lie outside the root.
    fn fate(&self, name: &str, path: &Path) -> Fate {
        let Ok(below) = path.strip_prefix(&self.root) else { return Fate::Passes };
        let line = without_numbers(&format!("{} {}", name.trim_end_matches("64"), below.display()));
        let is_matching = self.fault.as_ref().is_none_or(|fault| line.contains(&fault.pattern));
        let n_matching = match is_matching {
            true => self.counters.n_matching.fetch_add(1, Ordering::SeqCst) + 1,
            false => 0,
        };
        let fate = match &self.fault {
            Some(fault) if self.counters.is_hit.load(Ordering::SeqCst) == 1 => match fault.mode {
                Mode::Once | Mode::Kill => Fate::Passes,
                Mode::Dead => Fate::Fails(fault.errno),
                Mode::Cut => Fate::Kills,
            },
            Some(fault) if n_matching == fault.at => {
                self.counters.is_hit.store(1, Ordering::SeqCst);
                match fault.mode {
                    Mode::Once | Mode::Dead => Fate::Tears(fault.errno),
                    Mode::Kill | Mode::Cut => Fate::Kills,
                }
            }
            _ => Fate::Passes,
        };
        let mark = if fate == Fate::Passes { "" } else { "! " };
        drop((&self.calls).write_all(format!("{mark}{line}\n").as_bytes()));
        fate
    }

    fn loses_unsynced(&self) -> bool {
        self.fault.as_ref().is_some_and(|fault| fault.mode == Mode::Cut)
    }

    /// Saves a copy of a file's content, which survives a power cut.
    fn keep_synced(&self, fd: c_int) {
        if !self.loses_unsynced() || !path_of_fd(fd).is_some_and(|path| path.starts_with(&self.root)) {
            return;
        }
        let file = format!("/proc/self/fd/{fd}");
        if let Ok(metadata) = std::fs::metadata(&file)
            && metadata.is_file()
        {
            let kept = self.state.join(metadata.ino().to_string());
            let copy = kept.with_extension(std::process::id().to_string());
            drop(std::fs::copy(&file, &copy).and_then(|_n_bytes| std::fs::rename(&copy, &kept)));
        }
    }

    /// Discards the saved copy of a file that is about to be unlinked, because its inode may be reused.
    fn forget(&self, path: &Path) {
        if self.loses_unsynced()
            && path.starts_with(&self.root)
            && let Ok(metadata) = std::fs::symlink_metadata(path)
        {
            drop(std::fs::remove_file(self.state.join(metadata.ino().to_string())));
        }
    }
}

/// Replaces each number in the text by `#`, because rounds and process ids differ between runs.
fn without_numbers(text: &str) -> String {
    let mut short = String::new();
    for character in text.chars() {
        match character {
            '0'..='9' if short.ends_with('#') => {}
            '0'..='9' => short.push('#'),
            other => short.push(other),
        }
    }
    short
}

/// Returns the path of an open file.
fn path_of_fd(fd: c_int) -> Option<PathBuf> {
    std::fs::read_link(format!("/proc/self/fd/{fd}")).ok()
}

/// Returns the path argument of a call, resolved against `directory` if relative.
fn path_at(directory: c_int, path: *const c_char) -> Option<PathBuf> {
    // SAFETY: the caller of the intercepted function passes a C string.
    let path = Path::new(OsStr::from_bytes(unsafe { CStr::from_ptr(path) }.to_bytes()));
    let base = match directory {
        _ if path.is_absolute() => PathBuf::new(),
        AT_FDCWD => std::env::current_dir().ok()?,
        directory => path_of_fd(directory)?,
    };
    Some(base.join(path))
}

/// Returns the fate of the call `name` on `path`. A process killed here ends before the call takes effect.
fn fate(name: &str, path: impl FnOnce() -> Option<PathBuf>) -> Fate {
    let Some(disk) = DISK.get() else { return Fate::Passes };
    path().map_or(Fate::Passes, |path| disk.fate(name, &path))
}

fn failed(errno: c_int) -> c_int {
    // SAFETY: the location belongs to this thread.
    unsafe { *__errno_location() = errno };
    -1
}

fn die() -> ! {
    let pid = c_int::try_from(std::process::id()).expect("a process number");
    loop {
        // SAFETY: the call only ends this process.
        unsafe { kill(pid, SIGKILL) };
    }
}

/// Returns the next definition of this function, which the program would call without this object.
macro_rules! next {
    ($name:ident as $signature:ty) => {{
        static NEXT: AtomicPtr<c_void> = AtomicPtr::new(null_mut());
        let mut found = NEXT.load(Ordering::Relaxed);
        if found.is_null() {
            // SAFETY: the name is a C string.
            found = unsafe { dlsym(RTLD_NEXT, concat!(stringify!($name), "\0").as_ptr().cast()) };
            NEXT.store(found, Ordering::Relaxed);
        }
        // SAFETY: the C library has a function of this name and signature.
        unsafe { std::mem::transmute::<*mut c_void, $signature>(found) }
    }};
}

/// Functions that change a directory or a file's length. They do nothing when the fault affects them.
macro_rules! changes {
    ($($name:ident($($argument:ident: $type:ty),*) on $path:expr;)*) => {$(
        #[unsafe(no_mangle)]
        extern "C" fn $name($($argument: $type),*) -> c_int {
            match fate(stringify!($name), || $path) {
                Fate::Passes => {
                    let next = next!($name as extern "C" fn($($type),*) -> c_int);
                    next($($argument),*)
                }
                Fate::Tears(errno) | Fate::Fails(errno) => failed(errno),
                Fate::Kills => die(),
            }
        }
    )*};
}

changes! {
    ftruncate(fd: c_int, n_bytes: i64) on path_of_fd(fd);
    ftruncate64(fd: c_int, n_bytes: i64) on path_of_fd(fd);
    rename(from: *const c_char, to: *const c_char) on forget_replaced(path_at(AT_FDCWD, to));
    unlink(path: *const c_char) on forget_replaced(path_at(AT_FDCWD, path));
    unlinkat(directory: c_int, path: *const c_char, flags: c_int) on forget_replaced(path_at(directory, path));
    mkdir(path: *const c_char, mode: c_uint) on path_at(AT_FDCWD, path);
    rmdir(path: *const c_char) on path_at(AT_FDCWD, path);
}

/// Discards the saved copy of a file that is about to be replaced or removed, and returns its path.
fn forget_replaced(path: Option<PathBuf>) -> Option<PathBuf> {
    if let Some((disk, path)) = DISK.get().zip(path.as_ref()) {
        disk.forget(path);
    }
    path
}

/// Functions that open a file. They count as disk calls if they create or truncate it.
macro_rules! opens {
    ($($name:ident($($argument:ident: $type:ty),*; $flags:ident) at $directory:expr, $path:expr;)*) => {$(
        #[unsafe(no_mangle)]
        extern "C" fn $name($($argument: $type,)* $flags: c_int, mode: c_uint) -> c_int {
            let path = || {
                let path = path_at($directory, $path)?;
                let changes = $flags & O_TRUNC != 0 || ($flags & O_CREAT != 0 && !path.exists());
                changes.then_some(path)
            };
            let is_change = $flags & (O_CREAT | O_TRUNC) != 0;
            match if is_change { fate(stringify!($name), path) } else { Fate::Passes } {
                Fate::Passes => {
                    let next = next!($name as extern "C" fn($($type,)* c_int, c_uint) -> c_int);
                    next($($argument,)* $flags, mode)
                }
                Fate::Tears(errno) | Fate::Fails(errno) => failed(errno),
                Fate::Kills => die(),
            }
        }
    )*};
}

opens! {
    open(path: *const c_char; flags) at AT_FDCWD, path;
    open64(path: *const c_char; flags) at AT_FDCWD, path;
    openat64(directory: c_int, path: *const c_char; flags) at directory, path;
}

/// Functions that sync a file.
macro_rules! syncs {
    ($($name:ident)*) => {$(
        #[unsafe(no_mangle)]
        extern "C" fn $name(fd: c_int) -> c_int {
            match fate(stringify!($name), || path_of_fd(fd)) {
                Fate::Passes => {
                    let done = next!($name as extern "C" fn(c_int) -> c_int)(fd);
                    if let Some(disk) = DISK.get() {
                        disk.keep_synced(fd);
                    }
                    done
                }
                Fate::Tears(errno) | Fate::Fails(errno) => failed(errno),
                Fate::Kills => die(),
            }
        }
    )*};
}

syncs! { fsync fdatasync }

/// Calls `write` with `n` bytes, or with half of them if the fault affects this call.
fn tear(name: &str, fd: c_int, n: usize, mut write: impl FnMut(usize) -> isize) -> isize {
    let fate = fate(name, || path_of_fd(fd));
    if matches!(fate, Fate::Tears(_) | Fate::Kills) && n / 2 > 0 {
        write(n / 2);
    }
    match fate {
        Fate::Passes => write(n),
        Fate::Tears(errno) | Fate::Fails(errno) => failed(errno) as isize,
        Fate::Kills => die(),
    }
}

#[unsafe(no_mangle)]
extern "C" fn write(fd: c_int, bytes: *const c_void, n: usize) -> isize {
    let next = next!(write as extern "C" fn(c_int, *const c_void, usize) -> isize);
    tear("write", fd, n, |n| next(fd, bytes, n))
}

#[unsafe(no_mangle)]
extern "C" fn pwrite(fd: c_int, bytes: *const c_void, n: usize, offset: i64) -> isize {
    let next = next!(pwrite as extern "C" fn(c_int, *const c_void, usize, i64) -> isize);
    tear("pwrite", fd, n, |n| next(fd, bytes, n, offset))
}

#[unsafe(no_mangle)]
extern "C" fn pwrite64(fd: c_int, bytes: *const c_void, n: usize, offset: i64) -> isize {
    let next = next!(pwrite64 as extern "C" fn(c_int, *const c_void, usize, i64) -> isize);
    tear("pwrite64", fd, n, |n| next(fd, bytes, n, offset))
}

/// One buffer of a `writev` (`struct iovec`).
#[repr(C)]
#[derive(Clone, Copy)]
struct IoVec {
    bytes: *const c_void,
    n: usize,
}

#[unsafe(no_mangle)]
extern "C" fn writev(fd: c_int, buffers: *const IoVec, n_buffers: c_int) -> isize {
    let next = next!(writev as extern "C" fn(c_int, *const IoVec, c_int) -> isize);
    let n_buffers = usize::try_from(n_buffers).unwrap_or(0);
    // SAFETY: the caller passes this many buffers.
    let buffers = unsafe { std::slice::from_raw_parts(buffers, n_buffers) };
    let n_all = buffers.iter().map(|buffer| buffer.n).sum();
    tear("writev", fd, n_all, |n| {
        let mut left = n;
        let mut cut = buffers.to_vec();
        for buffer in &mut cut {
            buffer.n = buffer.n.min(left);
            left -= buffer.n;
        }
        next(fd, cut.as_ptr(), cut.len() as c_int)
    })
}

/// In-kernel copies. They fail with `ENOSYS`, so that callers fall back to `write`.
macro_rules! copies {
    ($($name:ident($($argument:ident: $type:ty),*) to $fd:ident;)*) => {$(
        #[unsafe(no_mangle)]
        extern "C" fn $name($($argument: $type),*) -> isize {
            let is_below = |disk: &Disk| path_of_fd($fd).is_some_and(|path| path.starts_with(&disk.root));
            if DISK.get().is_some_and(is_below) {
                return failed(ENOSYS) as isize;
            }
            let next = next!($name as extern "C" fn($($type),*) -> isize);
            next($($argument),*)
        }
    )*};
}

copies! {
    copy_file_range(from: c_int, at: *mut i64, to: c_int, to_at: *mut i64, n: usize, flags: c_uint) to to;
    sendfile64(to: c_int, from: c_int, at: *mut i64, n: usize) to to;
}
