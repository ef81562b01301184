//! Sums over the columns of rows and over rows, in a fixed order.

use cubecl::prelude::*;

use crate::buffers::buffer::{Buffer, Values};

/// Returns the sum of a value over the `lanes` units of a row; all units of the cube call it together.
#[cube]
pub(crate) fn sum_of_row(value: f32, stage: &mut Shared<[f32]>, #[comptime] lanes: usize) -> f32 {
    sync_cube();
    stage[UNIT_POS as usize] = value;
    sync_cube();
    let first = UNIT_POS as usize / lanes * lanes;
    let mut sum = 0.0f32;
    for i in 0..lanes {
        sum += stage[first + i];
    }
    sum
}

/// Returns the row of the unit, of `count` rows, in cubes of some rows of `lanes` units; the last row beyond it.
#[cube]
pub(crate) fn row_of_unit(count: usize, #[comptime] rows: usize, #[comptime] lanes: usize) -> usize {
    let cube = CUBE_POS_Y as usize * CUBE_COUNT_X as usize + CUBE_POS_X as usize;
    min(cube * rows + UNIT_POS as usize / lanes, count - 1)
}

/// Returns the sum of a vector's values.
#[cube]
pub(crate) fn sum_of_vector<V: Size>(vector: Vector<f32, V>) -> f32 {
    let mut sum = 0.0f32;
    #[unroll]
    for i in 0..V::value().comptime() {
        sum += vector.extract(i);
    }
    sum
}

/// Rows that a unit adds.
const CHUNK: usize = 64;
const UNITS: usize = 64;

/// Values that are summed over rows.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) enum Term {
    /// The gradient.
    Plain,
    /// The gradient by `(x - mean) inverse`; the statistics are mean and inverse of a row. The plain sums follow.
    Normal,
    /// The gradient by `x inverse`; the statistics are the inverses of the heads of a row.
    Head {
        /// Channels of a head.
        width: usize,
    },
}

/// Sums a chunk of rows: `[chunks][sums][columns]`.
#[cube(launch_unchecked)]
fn sum_chunks<V: Size>(
    grad: &[Vector<f32, V>],
    x: &[Vector<f32, V>],
    statistics: &[f32],
    partial: &mut [Vector<f32, V>],
    rows: usize,
    columns: usize,
    stride: usize,
    #[comptime] term: Term,
) {
    let width = V::value().comptime();
    let column = CUBE_POS_X as usize * UNITS + UNIT_POS as usize;
    let vectors = columns / width;
    if column < vectors {
        let first = CUBE_POS_Y as usize * CHUNK;
        let last = min(first + CHUNK, rows);
        let mut sum = Vector::<f32, V>::new(0.0);
        let mut plain = Vector::<f32, V>::new(0.0);
        for row in first..last {
            let index = row * (stride / width) + column;
            let value = grad[index];
            match comptime!(term) {
                Term::Plain => sum += value,
                Term::Normal => {
                    let mean = Vector::<f32, V>::new(statistics[row * 2]);
                    sum += value * (x[index] - mean) * Vector::<f32, V>::new(statistics[row * 2 + 1]);
                    plain += value;
                }
                Term::Head { width: head } => {
                    let inverse = statistics[row * (columns / head) + column * width / head];
                    sum += value * x[index] * Vector::<f32, V>::new(inverse);
                }
            }
        }
        if comptime!(term == Term::Normal) {
            let start = CUBE_POS_Y as usize * 2 * vectors;
            partial[start + column] = sum;
            partial[start + vectors + column] = plain;
        } else {
            partial[CUBE_POS_Y as usize * vectors + column] = sum;
        }
    }
}

/// Units that add the same column.
const LANES: usize = 8;
/// Columns of a cube.
const COLUMNS: usize = 32;

/// Sums over the first and the third dimension: `[chunks, parts, repeats, width] -> [parts, width]`. The chunks are `stride`
/// values apart. The second row of cubes sums the values after `columns` to `second`.
#[cube(launch_unchecked)]
fn sum_partial(
    partial: &[f32],
    first: &mut [f32],
    second: &mut [f32],
    columns: usize,
    stride: usize,
    chunks: usize,
    repeats: usize,
    width: usize,
) {
    let mut stage = Shared::<[f32]>::new_slice(comptime!(LANES * COLUMNS));
    let index = CUBE_POS_X as usize * COLUMNS + UNIT_POS as usize % COLUMNS;
    let lane = UNIT_POS as usize / COLUMNS;
    let mut sum = 0.0f32;
    if index < first.len() {
        let start = CUBE_POS_Y as usize * columns + index / width * repeats * width + index % width;
        let mut i = lane;
        while i < chunks * repeats {
            sum += partial[i / repeats * stride + start + i % repeats * width];
            i += LANES;
        }
    }
    stage[UNIT_POS as usize] = sum;
    sync_cube();
    if lane == 0 && index < first.len() {
        for i in 1..LANES {
            sum += stage[i * COLUMNS + UNIT_POS as usize];
        }
        if CUBE_POS_Y == 0 {
            first[index] = sum;
        } else {
            second[index] = sum;
        }
    }
}

/// Rows of `columns` values, `stride` apart.
#[derive(Clone, Copy, Debug)]
pub(crate) struct RowSizes {
    pub(crate) rows: usize,
    pub(crate) columns: usize,
    pub(crate) stride: usize,
}

/// Sums over rows, then over `repeats` groups of `width` columns; with [`Term::Normal`] the plain sums are the second result.
pub(crate) fn sum_over_rows(
    client: &Client,
    sizes: RowSizes,
    grad: &Buffer,
    [x, statistics]: [&Buffer; 2],
    term: Term,
    [repeats, width]: [usize; 2],
) -> Vec<Buffer> {
    let RowSizes { rows, columns, stride } = sizes;
    let chunks = rows.div_ceil(CHUNK);
    let num_sums = if term == Term::Normal { 2 } else { 1 };
    let partial = Buffer::empty(client, chunks * num_sums * columns, Values::F32);
    let aligned = [columns, stride, width].iter().all(|x| x.is_multiple_of(4));
    let vector = if aligned { 4 } else { 1 };
    // SAFETY: the kernels compare their indices with the sizes.
    unsafe {
        sum_chunks::launch_unchecked(
            client,
            CubeCount::Static((columns / vector).div_ceil(UNITS) as u32, chunks as u32, 1),
            CubeDim::new_1d(UNITS as u32),
            vector,
            grad.arg(vector),
            x.arg(vector),
            statistics.arg(1),
            partial.arg(vector),
            rows,
            columns,
            stride,
            term,
        );
    }
    let len = columns / repeats;
    let sums = [len, if num_sums == 2 { len } else { 1 }].map(|len| Buffer::empty(client, len, Values::F32));
    // SAFETY: as above.
    unsafe {
        sum_partial::launch_unchecked(
            client,
            CubeCount::Static(len.div_ceil(COLUMNS) as u32, num_sums as u32, 1),
            CubeDim::new_1d((LANES * COLUMNS) as u32),
            partial.arg(1),
            sums[0].arg(1),
            sums[1].arg(1),
            columns,
            num_sums * columns,
            chunks,
            repeats,
            width,
        );
    }
    sums.into_iter().take(num_sums).collect()
}

/// Sums over the rows of `x: [rows, columns]`, the gradient of a bias.
pub fn sum_rows(client: &Client, x: &Buffer, columns: usize) -> Buffer {
    let sizes = RowSizes { rows: x.len / columns, columns, stride: columns };
    sum_over_rows(client, sizes, x, [x, x], Term::Plain, [1, columns]).remove(0)
}
