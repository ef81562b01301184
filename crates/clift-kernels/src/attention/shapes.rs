//! Scaled dot-product attention without a score matrix: blocks of queries against blocks of keys,
//! all in the cache (the scheme of Dao et al. 2022, "`FlashAttention`").
//!
//! Heads are read where they lie, by stride, in rows that may be part of wider ones (packed
//! projections); each task copies its head once into a contiguous block.
// B scenes, H heads, Q queries, K keys, E width of a head

use crate::primitives::shared_slice::SharedSlice;

/// Sizes of one attention.
#[derive(Clone, Copy, Debug)]
pub struct Sizes {
    /// Scenes.
    pub batch: usize,
    /// Queries of a scene.
    pub num_queries: usize,
    /// Keys of a scene.
    pub num_keys: usize,
    /// Heads.
    pub num_heads: usize,
    /// Width of a head.
    pub head_width: usize,
}

impl Sizes {
    pub(crate) fn dim(&self) -> usize {
        self.num_heads * self.head_width
    }

    pub(crate) fn scale(&self) -> f32 {
        (1.0 / (self.head_width as f64).sqrt()) as f32
    }

    /// How many parts a head's work is cut into, so that 16 threads find work. A matter of shape
    /// alone, because sums over parts depend on it.
    pub(crate) fn parts(&self, blocks: usize) -> usize {
        16_usize.div_ceil((self.batch * self.num_heads).max(1)).clamp(1, blocks.max(1))
    }
}

/// Rows of tokens inside a slice that may hold more: `[batch, count, dim]` with strides.
#[derive(Clone, Copy, Debug)]
pub struct StridedRows<'a> {
    /// From the first value on.
    pub values: &'a [f32],
    /// Distance of two scenes.
    pub batch_stride: usize,
    /// Distance of two rows.
    pub row_stride: usize,
}

impl<'a> StridedRows<'a> {
    /// One head of one row.
    pub(crate) fn head(&self, sizes: &Sizes, scene: usize, row: usize, head: usize) -> &'a [f32] {
        let start = scene * self.batch_stride + row * self.row_stride + head * sizes.head_width;
        &self.values[start..start + sizes.head_width]
    }
}

/// Where [`backward`] puts its gradients, in contiguous rows.
#[derive(Debug)]
pub enum Gradients<'a> {
    /// Those of queries, keys and values side by side: `[batch, num_queries, 3 dim]`.
    Packed(&'a mut [f32]),
    /// Those of the queries on their own.
    Separate {
        /// `[batch, num_queries, dim]`
        query: &'a mut [f32],
        /// Those of keys and values side by side: `[batch, num_keys, 2 dim]`
        key_value: &'a mut [f32],
    },
}

/// Heads of contiguous rows that several threads write, each its own.
#[derive(Clone, Copy)]
pub(crate) struct HeadBlocks<'a> {
    pub(crate) values: &'a SharedSlice<'a>,
    /// Rows of a scene.
    pub(crate) count: usize,
    /// Values of a row, and where in it the first head starts.
    pub(crate) width: usize,
    pub(crate) first: usize,
}

impl HeadBlocks<'_> {
    /// Writes one head of one row.
    ///
    /// # Safety
    /// No other thread may write or read the same head of the same row.
    pub(crate) unsafe fn write(&self, [scene, row, head]: [usize; 3], values: impl ExactSizeIterator<Item = f32>) {
        let start = (scene * self.count + row) * self.width + self.first + head * values.len();
        // SAFETY: the caller's.
        let place = unsafe { self.values.part(start, values.len()) };
        place.iter_mut().zip(values).for_each(|(to, value)| *to = value);
    }
}

/// Queries in a block.
pub(crate) const QUERY_BLOCK: usize = 96;
/// Added to the length of a row of scores: rows a power of two apart would share cache sets.
pub(crate) const ROW_PADDING: usize = 16;

/// Copies rows one after the other, each followed by zeros up to `width`.
#[inline(always)]
pub(crate) fn copy_padded<'a>(to: &mut [f32], width: usize, rows: impl Iterator<Item = &'a [f32]>) {
    for (to, row) in to.chunks_exact_mut(width).zip(rows) {
        to[..row.len()].copy_from_slice(row);
        to[row.len()..].fill(0.0);
    }
}

/// Copies rows as columns of panels: a panel is `[head_width, panel]`, the last one padded with zeros.
#[inline(always)]
pub(crate) fn copy_transposed<'a>(
    to: &mut [f32],
    panel: usize,
    head_width: usize,
    mut rows: impl ExactSizeIterator<Item = &'a [f32]>,
) {
    for to in to.chunks_exact_mut(panel * head_width) {
        let columns = panel.min(rows.len());
        if columns < panel {
            to.fill(0.0);
        }
        for column in 0..columns {
            let row = rows.next().expect("the iterator has as many");
            for (to, &value) in to[column..].iter_mut().step_by(panel).zip(row) {
                *to = value;
            }
        }
    }
}
