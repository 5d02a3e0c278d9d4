//! The functions that JavaScript calls.
//!
//! They exchange bytes through two buffers in linear memory. The caller [`reserve`]s the input, writes to it and calls a
//! function, which returns 1 and leaves its result in the output, or 0 and leaves one line about the error.
#![expect(unsafe_code, reason = "an exported name is an unsafe attribute; no other code is unsafe")]

use std::cell::RefCell;

use serde_json::Value;
use tandem_core::ArmIndex;

use crate::error::Error;
use crate::page::{Page, Size, problem};

#[derive(Default)]
struct Buffers {
    input: Vec<u8>,
    output: Vec<u8>,
}

thread_local! {
    static PAGE: RefCell<Page> = RefCell::default();
    static BUFFERS: RefCell<Buffers> = RefCell::default();
}

/// Makes room for `length` bytes of input and returns their address.
#[unsafe(no_mangle)]
pub(crate) extern "C" fn reserve(length: usize) -> *mut u8 {
    BUFFERS.with_borrow_mut(|buffers| {
        buffers.input = vec![0; length];
        buffers.input.as_mut_ptr()
    })
}

/// Returns the address of the output.
#[unsafe(no_mangle)]
pub(crate) extern "C" fn output() -> *const u8 {
    BUFFERS.with_borrow(|buffers| buffers.output.as_ptr())
}

/// Returns the number of bytes of the output.
#[unsafe(no_mangle)]
pub(crate) extern "C" fn output_length() -> usize {
    BUFFERS.with_borrow(|buffers| buffers.output.len())
}

/// See [`Page::load_policy`]; the input is the file.
#[unsafe(no_mangle)]
pub(crate) extern "C" fn load_policy(start: u32) -> u32 {
    let bytes = take_input();
    json(|page| page.load_policy(&bytes, start.into()))
}

/// See [`Page::restart`].
#[unsafe(no_mangle)]
pub(crate) extern "C" fn restart(start: u32) -> u32 {
    json(|page| page.restart(start.into()))
}

/// See [`Page::step`].
#[unsafe(no_mangle)]
pub(crate) extern "C" fn step() -> u32 {
    json(Page::step)
}

/// See [`Page::move_goal`].
#[unsafe(no_mangle)]
pub(crate) extern "C" fn move_goal(arm: usize, x: f32, y: f32, z: f32) -> u32 {
    json(|page| page.move_goal(ArmIndex(arm), [x, y, z]))
}

/// See [`Page::drag_goal`].
#[unsafe(no_mangle)]
pub(crate) extern "C" fn drag_goal(arm: usize, x: f64, y: f64, width: usize, height: usize) -> u32 {
    json(|page| page.drag_goal(ArmIndex(arm), [x, y], Size { width, height }))
}

/// See [`Page::open_log`]; the input is the file.
#[unsafe(no_mangle)]
pub(crate) extern "C" fn open_log() -> u32 {
    let bytes = take_input();
    json(|page| page.open_log(&bytes))
}

/// See [`Page::draw`]; a negative position draws the policy's world.
#[unsafe(no_mangle)]
pub(crate) extern "C" fn draw(position: f64, width: usize, height: usize) -> u32 {
    let position = (position >= 0.0).then_some(position);
    json(|page| page.draw(position, Size { width, height }))
}

/// See [`Page::digest`].
#[unsafe(no_mangle)]
pub(crate) extern "C" fn digest() -> u32 {
    json(|page| page.digest())
}

fn take_input() -> Vec<u8> {
    BUFFERS.with_borrow_mut(|buffers| std::mem::take(&mut buffers.input))
}

fn json(call: impl FnOnce(&mut Page) -> Result<Value, Error>) -> u32 {
    let result = PAGE.with_borrow_mut(call);
    let is_done = result.is_ok();
    let text = result.map_or_else(|error| problem(&error), |value| value.to_string());
    BUFFERS.with_borrow_mut(|buffers| buffers.output = text.into_bytes());
    is_done.into()
}
