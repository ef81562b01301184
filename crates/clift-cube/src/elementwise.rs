//! Kernels with a unit a vector of values.

use cubecl::ir::ElemType;
use cubecl::prelude::*;

use crate::buffer::{Buffer, Values};

/// Units of a cube.
pub(crate) const UNITS: usize = 256;

/// Returns the width of vectors, and the cubes of a kernel with a unit a vector.
pub(crate) fn elementwise(len: usize) -> (usize, CubeCount) {
    let vector = if len.is_multiple_of(4) { 4 } else { 1 };
    let cubes = (len / vector).div_ceil(UNITS);
    let columns = cubes.min(1 << 15);
    (vector, CubeCount::Static(columns as u32, cubes.div_ceil(columns.max(1)) as u32, 1))
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

/// Returns the values in a type: the buffer itself if it has the type.
pub fn cast(client: &Client, x: &Buffer, values: Values) -> Buffer {
    if x.values == values {
        return x.clone();
    }
    let output = Buffer::empty(client, x.len, values);
    let (vector, count) = elementwise(x.len);
    let types = [x.values.elem(), values.elem()];
    // SAFETY: the kernel compares its index with the length.
    unsafe {
        copy::launch_unchecked(
            client,
            count,
            CubeDim::new_1d(UNITS as u32),
            vector,
            x.arg(vector),
            output.arg(vector),
            types,
        );
    }
    output
}
