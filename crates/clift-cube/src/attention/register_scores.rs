//! Parts of attention on register tiles.
// E width of a head; 16 rows of 8 units

use cubecl::prelude::*;

use crate::attention::head_rows::{Head, Rows, write_values};
use crate::buffers::load::{Four, load_four};
use crate::products::register_product::{fetch, put};

/// Rows of a cube.
pub(crate) const ROWS: usize = 64;
/// Columns of a block.
pub(crate) const COLUMNS: usize = 32;
/// Values of heads in a stage of scores.
pub(crate) const SLICE: usize = 16;
/// Columns of units, and all units.
pub(crate) const UNITS_X: usize = 8;
pub(crate) const UNITS: usize = 128;
pub(crate) const ROW_PITCH: usize = ROWS / 4 + 1;
pub(crate) const COLUMN_PITCH: usize = COLUMNS / 4 + 1;

/// Adds the scores of the unit's four rows (values of the vectors) and four columns, `sum_e row_e column_e`.
#[cube]
pub(crate) fn add_scores<R: Numeric, C: Numeric, V: Size>(
    scores: &mut Array<Four<f32>>,
    rows: &[Vector<R, V>],
    columns: &[Vector<C, V>],
    row_lines: &Rows,
    column_lines: &Rows,
    head: &Head,
    first_row: usize,
    first_column: usize,
    row_stage: &mut [Four<f32>],
    column_stage: &mut [Four<f32>],
    #[comptime] width: usize,
) {
    let x = UNIT_POS as usize % UNITS_X;
    let y = UNIT_POS as usize / UNITS_X;
    let mut row_next = Array::<Four<f32>>::new(comptime!((ROWS * SLICE / 16).div_ceil(UNITS) * 4));
    let mut column_next = Array::<Four<f32>>::new(comptime!((COLUMNS * SLICE / 16).div_ceil(UNITS) * 4));
    let row_start = row_lines.start_of(head);
    let column_start = column_lines.start_of(head);
    for slice in 0..comptime!(width.div_ceil(SLICE)) {
        let term = slice * SLICE;
        fetch::<R, V>(
            &mut row_next,
            rows,
            row_start,
            row_lines.stride,
            first_row,
            term,
            row_lines.count,
            width,
            true,
            ROWS,
            SLICE,
            UNITS,
        );
        fetch::<C, V>(
            &mut column_next,
            columns,
            column_start,
            column_lines.stride,
            first_column,
            term,
            column_lines.count,
            width,
            true,
            COLUMNS,
            SLICE,
            UNITS,
        );
        sync_cube();
        put(row_stage, &row_next, true, ROWS, SLICE, UNITS);
        put(column_stage, &column_next, true, COLUMNS, SLICE, UNITS);
        sync_cube();
        for e in 0..SLICE {
            let row = row_stage[e * ROW_PITCH + y];
            let column = column_stage[e * COLUMN_PITCH + x];
            #[unroll]
            for j in 0..4usize {
                scores[j] = fma(row, Four::<f32>::new(column.extract(j)), scores[j]);
            }
        }
    }
}

/// Copies the block's lines of heads, `[COLUMNS][width]`, to shared memory.
#[cube]
pub(crate) fn stage_lines<C: Numeric, V: Size>(
    stage: &mut [Four<f32>],
    from: &[Vector<C, V>],
    lines: &Rows,
    head: &Head,
    first: usize,
    #[comptime] width: usize,
) {
    let groups = comptime!(width.div_ceil(4));
    let pitch = comptime!(sum_fours(width) * UNITS_X);
    let start = lines.start_of(head);
    #[unroll]
    for step in 0..comptime!((COLUMNS * groups).div_ceil(UNITS)) {
        let group = UNIT_POS as usize + step * UNITS;
        if group < COLUMNS * groups {
            let line = group / groups;
            let four = group % groups;
            stage[line * pitch + four] =
                load_four::<C, V, f32>(from, start, lines.stride, first + line, four * 4, lines.count, width);
        }
    }
}

/// Returns the vectors of a row's sums that a unit has.
pub(crate) fn sum_fours(width: usize) -> usize {
    width.div_ceil(4).div_ceil(UNITS_X)
}

/// Adds `sum_c weight_rc line_c` to the unit's sums; the weights are `[COLUMNS][ROWS]`.
#[cube]
pub(crate) fn add_lines(
    sums: &mut Array<Four<f32>>,
    weights: &[Four<f32>],
    lines: &[Four<f32>],
    #[comptime] width: usize,
) {
    let x = UNIT_POS as usize % UNITS_X;
    let y = UNIT_POS as usize / UNITS_X;
    let fours = comptime!(sum_fours(width));
    for c in 0..COLUMNS {
        let weight = weights[c * ROW_PITCH + y];
        #[unroll]
        for g in 0..fours {
            let line = lines[c * comptime!(fours * UNITS_X) + x + g * UNITS_X];
            #[unroll]
            for i in 0..4usize {
                sums[i * fours + g] = fma(Four::<f32>::new(weight.extract(i)), line, sums[i * fours + g]);
            }
        }
    }
}

/// Writes the unit's sums, multiplied by the factor of their row.
#[cube]
pub(crate) fn write_sums<V: Size>(
    output: &mut [Vector<f32, V>],
    sums: &Array<Four<f32>>,
    factors: Four<f32>,
    lines: &Rows,
    head: &Head,
    first_row: usize,
    #[comptime] width: usize,
) {
    let x = UNIT_POS as usize % UNITS_X;
    let y = UNIT_POS as usize / UNITS_X;
    let fours = comptime!(sum_fours(width));
    let start = lines.start_of(head);
    #[unroll]
    for i in 0..4usize {
        let row = first_row + y * 4 + i;
        if row < lines.count {
            #[unroll]
            for g in 0..fours {
                let column = (x + g * UNITS_X) * 4;
                let values = sums[i * fours + g] * Four::<f32>::new(factors.extract(i));
                let index = start + row * lines.stride + column;
                write_values::<V>(output, values, index, column, width);
            }
        }
    }
}

#[cube]
pub(crate) fn clear(array: &mut Array<Four<f32>>) {
    #[unroll]
    for i in 0..array.len() {
        array[i] = Four::<f32>::new(0.0);
    }
}

/// Returns the unit's column `j` of the block that begins at `first`.
#[cube]
pub(crate) fn column_of(first: usize, j: usize) -> usize {
    first + UNIT_POS as usize % UNITS_X * 4 + j
}
