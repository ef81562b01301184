//! Products of matrices that stay in the cache, the building block of attention and of products in bf16.
// M rows, K inner, N columns

use std::mem::MaybeUninit;

use crate::simd::vector::{MATRIX_LANES, MATRIX_ROWS, MAX_LANES, Operands, Simd, Tile, has_matrix_tiles};

/// Lanes of A that are laid out for matrix tiles at a time.
const MATRIX_BLOCK: usize = 4 * MATRIX_LANES;

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
    // Rows and columns that fill no matrix tile are left to the register tile.
    let whole_rows = if has_matrix_tiles::<S, O>() { rows / MATRIX_ROWS * MATRIX_ROWS } else { 0 };
    // SAFETY: by the three assertions above.
    unsafe { multiply_matrix_tiles(simd, [whole_rows, inner, columns / width * width], a, b, (c, c_row), accumulate) };
    for panel in 0..=last_panel {
        let vectors = if panel == last_panel { last_columns / S::LANES } else { S::TILE_VECTORS };
        let mut row = if vectors == S::TILE_VECTORS { whole_rows } else { 0 };
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

/// Computes [`multiply`] by matrix tiles, for multiples of [`MATRIX_ROWS`] rows and columns. A transposed A is copied in blocks.
///
/// # Safety
/// A has `rows` rows of `inner` lanes, B all panels of `columns` columns, and C `rows` rows of `columns` columns.
#[inline(always)]
unsafe fn multiply_matrix_tiles<S: Simd>(
    simd: S,
    [rows, inner, columns]: [usize; 3],
    a: Left<'_>,
    b: Right<'_>,
    (c, c_row): (&mut [f32], usize),
    accumulate: bool,
) {
    let mut copied = [const { MaybeUninit::<f32>::uninit() }; MATRIX_ROWS * MATRIX_BLOCK];
    let copied = copied.as_mut_ptr().cast::<f32>();
    let block = if a.step == 1 { inner } else { inner.min(MATRIX_BLOCK) };
    for row in (0..rows).step_by(MATRIX_ROWS) {
        for lane in (0..inner).step_by(block) {
            let lanes = block.min(inner - lane);
            // SAFETY: the rows and lanes are in A, the panels in B, rows and columns in C; the copy has room for a block.
            unsafe {
                let mut left = (a.values.as_ptr().add(row * a.row + lane * a.step), a.row);
                if a.step > 1 {
                    copy_transposed(simd, left.0, a.step, lanes, copied);
                    left = (copied, MATRIX_BLOCK);
                }
                for panel in 0..columns / MATRIX_ROWS {
                    simd.multiply_tile(Tile {
                        inner: lanes,
                        a: left.0,
                        a_row: left.1,
                        a_step: 1,
                        b: b.values.as_ptr().add(panel * b.panel + lane * b.step),
                        b_step: b.step,
                        c: c.as_mut_ptr().add(row * c_row + panel * MATRIX_ROWS),
                        c_row,
                        accumulate: accumulate || lane > 0,
                    });
                }
            }
        }
    }
}

/// Copies lanes of [`MATRIX_ROWS`] rows, whose columns are contiguous, to rows of [`MATRIX_BLOCK`] lanes.
///
/// # Safety
/// The lanes must be readable, `to` writable for all rows.
#[inline(always)]
unsafe fn copy_transposed<S: Simd>(simd: S, from: *const f32, step: usize, lanes: usize, to: *mut f32) {
    for row in (0..MATRIX_ROWS).step_by(S::LANES) {
        for lane in (0..lanes).step_by(S::LANES) {
            // SAFETY: by the caller's promise.
            unsafe {
                // By a loop, as in `pack_transposed`.
                let mut block = [simd.splat(0.0); MAX_LANES];
                for (i, vector) in block.iter_mut().enumerate() {
                    *vector = simd.load(from.add((lane + i) * step + row));
                }
                simd.transpose(&mut block);
                for (i, vector) in block.into_iter().enumerate() {
                    simd.store(to.add((row + i) * MATRIX_BLOCK + lane), vector);
                }
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
