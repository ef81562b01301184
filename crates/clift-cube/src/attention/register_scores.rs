//! Parts of attention on register tiles.
// E width of a head; 16 rows of 8 units

use cubecl::prelude::*;

use crate::attention::head_rows::write_values;
use crate::buffers::load::{Four, Side, load_four};
use crate::products::register_product::{StagePart, fetch, put};

/// Rows of a cube.
pub(crate) const ROWS: usize = 64;
/// Columns of a block.
pub(crate) const COLUMNS: usize = 32;
/// Values of heads in a stage of scores.
const SLICE: usize = 16;
/// Columns of units, and all units.
pub(crate) const UNITS_X: usize = 8;
pub(crate) const UNITS: usize = 128;
pub(crate) const ROW_PITCH: usize = ROWS / 4 + 1;
const COLUMN_PITCH: usize = COLUMNS / 4 + 1;

const fn part(side: usize) -> StagePart {
    StagePart { terms_inner: true, side, terms: SLICE, units: UNITS }
}

/// Shared memory of a cube: stages of scores, weights `[COLUMNS][ROWS]`, and lines of heads `[COLUMNS][width]`.
#[derive(CubeType)]
pub(crate) struct Stages {
    pub(crate) rows: Shared<[Four<f32>]>,
    columns: Shared<[Four<f32>]>,
    pub(crate) weights: Shared<[Four<f32>]>,
    lines: Shared<[Four<f32>]>,
}

#[cube]
impl Stages {
    pub(crate) fn new(#[comptime] width: usize) -> Stages {
        Stages {
            rows: Shared::<[Four<f32>]>::new_slice(SLICE * ROW_PITCH),
            columns: Shared::<[Four<f32>]>::new_slice(SLICE * COLUMN_PITCH),
            weights: Shared::<[Four<f32>]>::new_slice(COLUMNS * ROW_PITCH),
            lines: Shared::<[Four<f32>]>::new_slice(comptime!(COLUMNS * sum_fours(width) * UNITS_X)),
        }
    }
}

/// Adds the scores of the unit's four rows (values of the vectors) and four columns, `sum_e row_e column_e`.
#[cube]
pub(crate) fn add_scores<R: Numeric, C: Numeric, V: Size>(
    scores: &mut Array<Four<f32>>,
    rows: &[Vector<R, V>],
    columns: &[Vector<C, V>],
    row_side: &Side,
    column_side: &Side,
    stages: &mut Stages,
    #[comptime] width: usize,
) {
    let x = UNIT_POS as usize % UNITS_X;
    let y = UNIT_POS as usize / UNITS_X;
    let (row_part, column_part) = comptime!((part(ROWS), part(COLUMNS)));
    let mut row_next = Array::<Four<f32>>::new(comptime!(row_part.fetches()));
    let mut column_next = Array::<Four<f32>>::new(comptime!(column_part.fetches()));
    for slice in 0..comptime!(width.div_ceil(SLICE)) {
        fetch::<R, V>(&mut row_next, rows, row_side, slice * SLICE, width, row_part);
        fetch::<C, V>(&mut column_next, columns, column_side, slice * SLICE, width, column_part);
        sync_cube();
        put(&mut stages.rows, &row_next, row_part);
        put(&mut stages.columns, &column_next, column_part);
        sync_cube();
        for e in 0..SLICE {
            let row = stages.rows[e * ROW_PITCH + y];
            let column = stages.columns[e * COLUMN_PITCH + x];
            #[unroll]
            for j in 0..4usize {
                scores[j] = fma(row, Four::<f32>::new(column.extract(j)), scores[j]);
            }
        }
    }
}

/// Copies the block's lines of heads to shared memory.
#[cube]
pub(crate) fn stage_lines<C: Numeric, V: Size>(
    stages: &mut Stages,
    from: &[Vector<C, V>],
    side: &Side,
    #[comptime] width: usize,
) {
    let groups = comptime!(width.div_ceil(4));
    let pitch = comptime!(sum_fours(width) * UNITS_X);
    #[unroll]
    for step in 0..comptime!((COLUMNS * groups).div_ceil(UNITS)) {
        let group = UNIT_POS as usize + step * UNITS;
        if group < COLUMNS * groups {
            let line = group / groups;
            let four = group % groups;
            let (outer, inner) = (side.first + line, four * 4);
            stages.lines[line * pitch + four] =
                load_four::<C, V, f32>(from, side.start, side.stride, outer, inner, side.limit, width);
        }
    }
}

/// Returns the vectors of a row's sums that a unit has.
pub(crate) fn sum_fours(width: usize) -> usize {
    width.div_ceil(4).div_ceil(UNITS_X)
}

/// Adds `sum_c weight_rc line_c` to the unit's sums.
#[cube]
pub(crate) fn add_lines(sums: &mut Array<Four<f32>>, stages: &Stages, #[comptime] width: usize) {
    let x = UNIT_POS as usize % UNITS_X;
    let y = UNIT_POS as usize / UNITS_X;
    let fours = comptime!(sum_fours(width));
    for c in 0..COLUMNS {
        let weight = stages.weights[c * ROW_PITCH + y];
        #[unroll]
        for g in 0..fours {
            let line = stages.lines[c * comptime!(fours * UNITS_X) + x + g * UNITS_X];
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
    to: &Side,
    #[comptime] width: usize,
) {
    let x = UNIT_POS as usize % UNITS_X;
    let y = UNIT_POS as usize / UNITS_X;
    let fours = comptime!(sum_fours(width));
    #[unroll]
    for i in 0..4usize {
        let row = to.first + y * 4 + i;
        if row < to.limit {
            #[unroll]
            for g in 0..fours {
                let column = (x + g * UNITS_X) * 4;
                let values = sums[i * fours + g] * Four::<f32>::new(factors.extract(i));
                let index = to.start + row * to.stride + column;
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

/// Returns `count` vectors of zeros.
#[cube]
pub(crate) fn zeros(#[comptime] count: usize) -> Array<Four<f32>> {
    let mut array = Array::<Four<f32>>::new(count);
    clear(&mut array);
    array
}

/// Returns the unit's column `j` of the block that begins at `first`.
#[cube]
pub(crate) fn column_of(first: usize, j: usize) -> usize {
    first + UNIT_POS as usize % UNITS_X * 4 + j
}
