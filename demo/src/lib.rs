//! The simulator and the shipped policies in a browser.
//!
//! [`page`] is the state of the page, without any access to it: [`live`] plays a policy for goals that a visitor moves,
//! [`log`] reads the log of an episode and [`replay`] simulates it again. [`digest`] hashes episodes: processors that
//! compute the same bits give equal digests. JavaScript calls the functions in `exports`.
#![warn(missing_docs)]

pub mod digest;
mod drawing;
pub mod error;
#[cfg(target_arch = "wasm32")]
mod exports;
mod fields;
pub mod live;
pub mod log;
pub mod page;
pub mod replay;
