//! Products of matrices that stay in the cache, the building block of attention and of products in bf16.
// M rows, K inner, N columns

use std::mem::MaybeUninit;

use crate::primitives::packing::has_matrix_tiles;
use crate::simd::vector::{MATRIX_LANES, MATRIX_ROWS, MAX_LANES, Operands, Simd, Tile};

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
    if has_matrix_tiles::<S, O>() {
        // SAFETY: by the three assertions above.
        return unsafe { multiply_matrix_tiles(simd, [rows, inner, columns], a, b, (c, c_row), accumulate) };
    }
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

/// Computes [`multiply`] by matrix tiles. A is read where it lies if its rows are contiguous and fill a tile; otherwise, blocks of
/// it are copied.
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
    assert!(inner.is_multiple_of(MATRIX_LANES), "operands are padded to whole tiles");
    let width = panel_width::<S>();
    assert!(width == MATRIX_ROWS && S::LANES == MATRIX_LANES, "a panel is a tile wide");
    let mut copied = [const { MaybeUninit::<f32>::uninit() }; MATRIX_ROWS * MATRIX_BLOCK];
    let mut edge = [const { MaybeUninit::<f32>::uninit() }; MATRIX_ROWS * MATRIX_ROWS];
    let (copied, edge) = (copied.as_mut_ptr().cast::<f32>(), edge.as_mut_ptr().cast::<f32>());
    for row in (0..rows).step_by(MATRIX_ROWS) {
        let count = MATRIX_ROWS.min(rows - row);
        let in_place = a.step == 1 && count == MATRIX_ROWS;
        let block = if in_place { inner } else { inner.min(MATRIX_BLOCK) };
        for lane in (0..inner).step_by(block) {
            let lanes = block.min(inner - lane);
            let accumulate = accumulate || lane > 0;
            // SAFETY: the rows and lanes are in A; the copy has room for a block.
            let (left, left_row) = unsafe {
                let from = a.values.as_ptr().add(row * a.row + lane * a.step);
                if in_place {
                    (from, a.row)
                } else {
                    copy_rows(simd, from, [a.row, a.step], [count, lanes], copied);
                    (copied.cast_const(), MATRIX_BLOCK)
                }
            };
            for panel in 0..columns.div_ceil(width) {
                let vectors = S::TILE_VECTORS.min(columns / S::LANES - panel * S::TILE_VECTORS);
                let whole = count == MATRIX_ROWS && vectors == S::TILE_VECTORS;
                // SAFETY: B has `vectors` vectors in this panel, C the `count` rows of them or `edge` a whole tile.
                unsafe {
                    let to = c.as_mut_ptr().add(row * c_row + panel * width);
                    let tile = Tile {
                        inner: lanes,
                        a: left,
                        a_row: left_row,
                        a_step: 1,
                        b: b.values.as_ptr().add(panel * b.panel + lane * b.step),
                        b_step: b.step,
                        c: if whole { to } else { edge },
                        c_row: if whole { c_row } else { MATRIX_ROWS },
                        accumulate: accumulate && whole,
                    };
                    simd.multiply_tile(tile, vectors);
                    if !whole {
                        copy_edge(simd, edge, [count, vectors], (to, c_row), accumulate);
                    }
                }
            }
        }
    }
}

/// Copies a block of A to rows of [`MATRIX_BLOCK`] lanes; missing rows are zero.
///
/// # Safety
/// The block must be readable, `to` writable for all rows.
#[inline(always)]
unsafe fn copy_rows<S: Simd>(
    simd: S,
    from: *const f32,
    [row, step]: [usize; 2],
    [rows, lanes]: [usize; 2],
    to: *mut f32,
) {
    assert!(row == 1 || step == 1, "rows or columns of A are contiguous");
    for (first, lane) in
        (0..MATRIX_ROWS).step_by(S::LANES).flat_map(|r| (0..lanes).step_by(S::LANES).map(move |l| (r, l)))
    {
        let mut block = [simd.splat(0.0); MAX_LANES];
        let count = rows.saturating_sub(first).min(S::LANES);
        // SAFETY: by the caller's promise.
        unsafe {
            if step == 1 {
                for (r, vector) in block.iter_mut().enumerate().take(count) {
                    *vector = simd.load(from.add((first + r) * row + lane));
                }
            } else if count > 0 {
                for (l, vector) in block.iter_mut().enumerate() {
                    let column = from.add((lane + l) * step + first);
                    *vector = if count == S::LANES {
                        simd.load(column)
                    } else {
                        simd.read(std::slice::from_raw_parts(column, count))
                    };
                }
                simd.transpose(&mut block);
            }
            for (r, vector) in block.into_iter().enumerate() {
                simd.store(to.add((first + r) * MATRIX_BLOCK + lane), vector);
            }
        }
    }
}

/// Writes rows and vectors of a tile to C, or adds them.
///
/// # Safety
/// Both must have that many rows and vectors.
#[inline(always)]
unsafe fn copy_edge<S: Simd>(
    simd: S,
    edge: *const f32,
    [rows, vectors]: [usize; 2],
    (c, c_row): (*mut f32, usize),
    accumulate: bool,
) {
    for (row, vector) in (0..rows).flat_map(|row| (0..vectors).map(move |vector| (row, vector * S::LANES))) {
        // SAFETY: by the caller's promise.
        unsafe {
            let (value, to) = (simd.load(edge.add(row * MATRIX_ROWS + vector)), c.add(row * c_row + vector));
            simd.store(to, if accumulate { simd.add(simd.load(to), value) } else { value });
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
