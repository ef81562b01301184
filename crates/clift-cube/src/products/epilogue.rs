//! Epilogue of a product: steps between its sums and its output.

use cubecl::prelude::*;

use crate::buffers::load::Four;
use crate::rows::gelu::gelu;

/// Steps after the sum, in their order.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub(crate) struct Epilogue {
    pub(crate) bias: bool,
    pub(crate) gelu: bool,
    pub(crate) residual: bool,
}

/// Writes four sums of a row, as far as they are inside the matrix: `gelu(sum + bias) + residual`.
#[cube]
pub(crate) fn write_four<O: Float, V: Size>(
    output: &mut [Vector<O, V>],
    bias: &[f32],
    residual: &[Vector<f32, V>],
    sums: Four<f32>,
    start: usize,
    row: usize,
    column: usize,
    rows: usize,
    columns: usize,
    #[comptime] epilogue: Epilogue,
) {
    if row < rows && column < columns {
        let mut values = sums;
        if comptime!(epilogue.bias) {
            #[unroll]
            for i in 0..4usize {
                if column + i < columns {
                    values.insert(i, values.extract(i) + bias[column + i]);
                }
            }
        }
        if comptime!(epilogue.gelu) {
            #[unroll]
            for i in 0..4usize {
                values.insert(i, gelu(values.extract(i)));
            }
        }
        let width = V::value().comptime();
        let index = start + row * columns + column;
        if comptime!(width == 4) {
            if comptime!(epilogue.residual) {
                values += Four::<f32>::cast_from(residual[index / 4]);
            }
            output[index / 4] = Vector::cast_from(values);
        } else {
            #[unroll]
            for i in 0..4usize {
                if column + i < columns {
                    let mut value = values.extract(i);
                    if comptime!(epilogue.residual) {
                        value += residual[index + i].extract(0usize);
                    }
                    output[index + i] = Vector::cast_from(value);
                }
            }
        }
    }
}
