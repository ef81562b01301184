use std::cell::RefCell;
use std::ops::{Deref, DerefMut};

thread_local! {
    static KEPT: RefCell<Vec<f32>> = const { RefCell::new(Vec::new()) };
}

/// A slice that this thread keeps for the next user: big temporary allocations cost page faults
/// every time. Its values are whatever the last user left.
///
/// A guard rather than a closure's argument: code in a closure is not compiled with the instructions
/// of the function around it.
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

/// Cuts a slice into parts of the given lengths.
pub(crate) fn cut<const COUNT: usize>(mut slice: &mut [f32], lens: [usize; COUNT]) -> [&mut [f32]; COUNT] {
    lens.map(|len| {
        let (part, rest) = std::mem::take(&mut slice).split_at_mut(len);
        slice = rest;
        part
    })
}
