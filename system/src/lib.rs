//! Access to the operating system that several crates share: files that are replaced atomically, bounded reads, locks
//! on directories, the usage of a process and the limit of open files.
//!
//! The crate depends on no other crate of the workspace and knows none of their types.
#![warn(missing_docs)]

pub mod atomic_file;
pub mod directory_lock;
pub mod fd_limit;
pub mod process;
pub mod regular_file;

pub use directory_lock::DirectoryLock;
