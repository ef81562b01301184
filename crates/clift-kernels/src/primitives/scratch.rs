//! Reusable buffers, one per thread.

use std::cell::RefCell;

thread_local! {
    static KEPT: RefCell<Vec<f32>> = const { RefCell::new(Vec::new()) };
}

/// A buffer that this thread keeps for its next kernel, because large temporary allocations cost page faults. The values
/// are those of the last kernel.
///
/// A guard instead of a closure: code in a closure is not compiled with the instructions of the enclosing function.
pub(crate) struct Scratch {
    values: Vec<f32>,
}

impl Scratch {
    pub(crate) fn take(len: usize) -> Self {
        let mut values = KEPT.take();
        if values.len() < len {
            values = vec![0.0; len];
        }
        Self { values }
    }

    pub(crate) fn cut<const COUNT: usize>(&mut self, lens: [usize; COUNT]) -> [&mut [f32]; COUNT] {
        let mut slice = self.values.as_mut_slice();
        lens.map(|len| {
            let (part, rest) = std::mem::take(&mut slice).split_at_mut(len);
            slice = rest;
            part
        })
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        KEPT.set(std::mem::take(&mut self.values));
    }
}
