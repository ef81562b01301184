//! Elementwise kernels: one unit per vector of values.

use cubecl::ir::ElemType;
use cubecl::prelude::*;

use crate::buffers::buffer::{Buffer, Values};

/// Units of a cube.
pub(crate) const UNITS: usize = 256;

/// Returns the width of vectors, the count of cubes and their size for an elementwise kernel.
pub(crate) fn elementwise(len: usize) -> (usize, CubeCount, CubeDim) {
    let vector = if len.is_multiple_of(4) { 4 } else { 1 };
    (vector, cube_count((len / vector).div_ceil(UNITS)), CubeDim::new_1d(UNITS as u32))
}

/// Returns a count of at least `cubes` cubes in two dimensions, each within the limit of adapters (65,535).
pub(crate) fn cube_count(cubes: usize) -> CubeCount {
    let columns = cubes.min(1 << 15);
    CubeCount::Static(columns as u32, cubes.div_ceil(columns.max(1)) as u32, 1)
}

#[cube(launch_unchecked)]
fn copy<X: Float, O: Float, V: Size>(
    x: &[Vector<X, V>],
    output: &mut [Vector<O, V>],
    #[define(X, O)] _types: [ElemType; 2],
) {
    if ABSOLUTE_POS < x.len() {
        output[ABSOLUTE_POS] = Vector::cast_from(x[ABSOLUTE_POS]);
    }
}

/// Converts values to a type; a buffer of that type is returned as it is.
pub fn cast(client: &Client, x: &Buffer, values: Values) -> Buffer {
    if x.values == values {
        return x.clone();
    }
    let output = Buffer::empty(client, x.len, values);
    let (vector, count, dim) = elementwise(x.len);
    let types = [x.values.elem(), values.elem()];
    // SAFETY: the kernel compares its index with the length.
    unsafe {
        copy::launch_unchecked(client, count, dim, vector, x.arg(vector), output.arg(vector), types);
    }
    output
}
