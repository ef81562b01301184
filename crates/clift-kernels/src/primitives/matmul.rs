//! Products of matrices that stay in the cache, the building block of attention and of products in bf16.
// M rows, K inner, N columns

use crate::simd::vector::{Operands, Simd, Tile};

/// The left factor, a strided matrix in a slice.
#[derive(Clone, Copy)]
pub(crate) struct Left<'a> {
    pub values: &'a [f32],
    /// Values from one row to the next.
    pub row: usize,
    /// Values from one column to the next.
    pub step: usize,
}

/// The right factor, divided into panels of contiguous columns that the register tile reads row by row.
#[derive(Clone, Copy)]
pub(crate) struct Right<'a> {
    pub values: &'a [f32],
    /// Values from one row of a panel to the next.
    pub step: usize,
    /// Values from one panel to the next.
    pub panel: usize,
}

#[inline(always)]
pub(crate) fn panel_width<S: Simd>() -> usize {
    S::LANES * S::TILE_VECTORS
}

#[inline(always)]
pub(crate) fn padded<S: Simd>(columns: usize) -> usize {
    columns.next_multiple_of(S::LANES)
}

/// Computes `C[rows, columns] = A[rows, inner] B[inner, columns]`, or adds the product to C, with `inner` counted in lanes.
/// Whole vectors of columns are computed: B and C must have [`padded`] columns.
#[inline(always)]
pub(crate) fn multiply<S: Simd, O: Operands>(
    simd: S,
    [rows, inner, columns]: [usize; 3],
    a: Left<'_>,
    b: Right<'_>,
    (c, c_row): (&mut [f32], usize),
    accumulate: bool,
) {
    if rows == 0 || columns == 0 || inner == 0 {
        assert!(accumulate || rows == 0 || columns == 0, "an empty product cannot overwrite C");
        return;
    }
    let (columns, width) = (padded::<S>(columns), panel_width::<S>());
    let last_panel = (columns - 1) / width;
    let last_columns = columns - last_panel * width;
    assert!(a.values.len() > (rows - 1) * a.row + (inner - 1) * a.step, "A has `rows` rows");
    assert!(b.values.len() >= last_panel * b.panel + (inner - 1) * b.step + last_columns, "B has all panels");
    assert!(c.len() >= (rows - 1) * c_row + columns, "C has `rows` rows");
    for panel in 0..=last_panel {
        let vectors = if panel == last_panel { last_columns / S::LANES } else { S::TILE_VECTORS };
        let mut row = 0;
        while row < rows {
            // SAFETY: the three assertions above cover rows `row..row + ..` of A and C and the panel of B.
            unsafe {
                let tile = Tile {
                    inner,
                    a: a.values.as_ptr().add(row * a.row),
                    a_row: a.row,
                    a_step: a.step,
                    b: b.values.as_ptr().add(panel * b.panel),
                    b_step: b.step,
                    c: c.as_mut_ptr().add(row * c_row + panel * width),
                    c_row,
                    accumulate,
                };
                row += run_tile::<S, O>(simd, tile, rows - row, vectors);
            }
        }
    }
}

/// Runs the largest tile that fits into `rows` rows and is `vectors` wide, as [`Tile::run`]; returns its rows.
#[inline(always)]
unsafe fn run_tile<S: Simd, O: Operands>(simd: S, tile: Tile, rows: usize, vectors: usize) -> usize {
    // SAFETY: by the caller's promise.
    unsafe {
        match (S::TILE_ROWS, vectors) {
            (12, 2) if rows >= 12 => tile.run::<S, O, 12, 2>(simd),
            (6, 2) if rows >= 6 => tile.run::<S, O, 6, 2>(simd),
            (_, 2) if rows >= 4 => tile.run::<S, O, 4, 2>(simd),
            (_, 2) => tile.run::<S, O, 1, 2>(simd),
            (6 | 12, _) if rows >= 8 => tile.run::<S, O, 8, 1>(simd),
            (_, _) if rows >= 4 => tile.run::<S, O, 4, 1>(simd),
            (_, _) => tile.run::<S, O, 1, 1>(simd),
        }
    }
}
