//! Sizes, strided rows and blocks of a head.
// B scenes, H heads, Q queries, K keys, E width of a head

use crate::primitives::shared_slice::SharedSlice;

/// Sizes of an attention.
#[derive(Clone, Copy, Debug)]
pub struct AttentionSizes {
    /// Number of scenes.
    pub batch: usize,
    /// Queries per scene.
    pub num_queries: usize,
    /// Keys per scene.
    pub num_keys: usize,
    /// Number of heads.
    pub num_heads: usize,
    /// Width of one head.
    pub head_width: usize,
}

impl AttentionSizes {
    pub(crate) fn dim(&self) -> usize {
        self.num_heads * self.head_width
    }

    pub(crate) fn scale(&self) -> f32 {
        (1.0 / (self.head_width as f64).sqrt()) as f32
    }

    /// Returns the factor of products of queries and keys in exponents of 2.
    pub(crate) fn exponent_scale(&self) -> f32 {
        self.scale() * std::f32::consts::LOG2_E
    }

    /// Returns the parts that the blocks of a head are divided into, for 16 threads: by shape alone, for equal sums.
    pub(crate) fn parts(&self, blocks: usize) -> usize {
        16_usize.div_ceil((self.batch * self.num_heads).max(1)).clamp(1, blocks.max(1))
    }
}

/// Rows of tokens in a slice, `[batch, count, dim]` with strides.
#[derive(Clone, Copy, Debug)]
pub struct StridedRows<'a> {
    /// Values, starting with the first row of the first scene.
    pub values: &'a [f32],
    /// Values from one scene to the next.
    pub batch_stride: usize,
    /// Values from one row to the next.
    pub row_stride: usize,
}

impl<'a> StridedRows<'a> {
    pub(crate) fn head(&self, sizes: &AttentionSizes, scene: usize, row: usize, head: usize) -> &'a [f32] {
        let start = scene * self.batch_stride + row * self.row_stride + head * sizes.head_width;
        &self.values[start..start + sizes.head_width]
    }
}

/// Contiguous rows that several threads write, each thread its own heads.
#[derive(Clone, Copy)]
pub(crate) struct HeadBlocks<'a> {
    pub(crate) values: &'a SharedSlice<'a>,
    pub(crate) count: usize,
    pub(crate) width: usize,
    /// Position of the first head in a row.
    pub(crate) first: usize,
}

impl HeadBlocks<'_> {
    /// Writes one head of one row.
    ///
    /// # Safety
    /// No other thread may read or write this head of this row at the same time.
    #[inline(always)]
    pub(crate) unsafe fn write(&self, [scene, row, head]: [usize; 3], values: impl ExactSizeIterator<Item = f32>) {
        let start = (scene * self.count + row) * self.width + self.first + head * values.len();
        // SAFETY: by the caller's promise.
        let place = unsafe { self.values.part(start, values.len()) };
        place.iter_mut().zip(values).for_each(|(to, value)| *to = value);
    }
}

pub(crate) const QUERY_BLOCK: usize = 96;
/// Padding of a row of scores: rows a power of two apart would share cache sets.
pub(crate) const ROW_PADDING: usize = 16;
