//! Rows of heads in a buffer.

use cubecl::prelude::*;

use crate::buffers::load::{Four, Side};

/// The rows of a buffer.
#[derive(CubeType, CubeLaunch, Clone, Copy)]
pub(crate) struct Rows {
    pub(crate) start: usize,
    pub(crate) stride: usize,
    pub(crate) count: usize,
}

/// Rows of an attention, or the gradient of the output in place of the output; the scale of its scores.
#[derive(CubeType, CubeLaunch, Clone, Copy)]
pub(crate) struct Attention {
    pub(crate) query: Rows,
    pub(crate) key: Rows,
    pub(crate) value: Rows,
    pub(crate) output: Rows,
    pub(crate) num_heads: usize,
    pub(crate) scale: f32,
}

/// A scene and the first column of a head.
#[derive(CubeType, Clone, Copy)]
pub(crate) struct Head {
    pub(crate) batch: usize,
    pub(crate) column: usize,
}

#[cube]
impl Rows {
    /// Returns the offset of the head's first row.
    pub(crate) fn start_of(&self, head: &Head) -> usize {
        self.start + head.batch * self.count * self.stride + head.column
    }

    /// Returns the head's rows from `first`.
    pub(crate) fn side(&self, head: &Head, first: usize) -> Side {
        Side { start: self.start_of(head), stride: self.stride, first, limit: self.count }
    }
}

/// Returns the head of a cube: the second position counts scenes and heads.
#[cube]
pub(crate) fn head_of_cube(num_heads: usize, width: usize) -> Head {
    Head { batch: CUBE_POS_Y as usize / num_heads, column: CUBE_POS_Y as usize % num_heads * width }
}

/// Writes the values of a vector whose column is below `limit`.
#[cube]
pub(crate) fn write_values<V: Size>(
    output: &mut [Vector<f32, V>],
    values: Four<f32>,
    index: usize,
    column: usize,
    limit: usize,
) {
    let width = V::value().comptime();
    if comptime!(width == 4) {
        if column < limit {
            output[index / 4] = Vector::cast_from(values);
        }
    } else {
        #[unroll]
        for i in 0..4usize {
            if column + i < limit {
                output[index + i] = Vector::cast_from(values.extract(i));
            }
        }
    }
}

/// Reads the four values of rows at `first`, 0 for rows at and after the limit.
#[cube]
pub(crate) fn read_rows(from: &[f32], start: usize, first: usize, limit: usize) -> Four<f32> {
    let mut values = Four::<f32>::new(0.0);
    #[unroll]
    for i in 0..4usize {
        if first + i < limit {
            values.insert(i, from[start + first + i]);
        }
    }
    values
}
