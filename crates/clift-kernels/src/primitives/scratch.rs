//! Reusable buffers, one per thread.

use std::cell::RefCell;
use std::ops::{Deref, DerefMut};

thread_local! {
    static KEPT: RefCell<Vec<f32>> = const { RefCell::new(Vec::new()) };
}

/// A buffer that this thread keeps for its next kernel, because large temporary allocations cost page faults. The values
/// are those of the last kernel.
///
/// A guard instead of a closure: code in a closure is not compiled with the instructions of the enclosing function.
pub(crate) struct Scratch {
    values: Vec<f32>,
    len: usize,
}

impl Scratch {
    pub(crate) fn take(len: usize) -> Self {
        let mut values = KEPT.take();
        if values.len() < len {
            values = vec![0.0; len];
        }
        Self { values, len }
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        KEPT.set(std::mem::take(&mut self.values));
    }
}

impl Deref for Scratch {
    type Target = [f32];

    fn deref(&self) -> &[f32] {
        &self.values[..self.len]
    }
}

impl DerefMut for Scratch {
    fn deref_mut(&mut self) -> &mut [f32] {
        &mut self.values[..self.len]
    }
}

/// Splits a slice into parts of the given lengths.
pub(crate) fn cut<const COUNT: usize>(mut slice: &mut [f32], lens: [usize; COUNT]) -> [&mut [f32]; COUNT] {
    lens.map(|len| {
        let (part, rest) = std::mem::take(&mut slice).split_at_mut(len);
        slice = rest;
        part
    })
}
