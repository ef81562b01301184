//! Operands of matrix products, laid out for the register tile.

use crate::simd::vector::{MATRIX_LANES, MAX_LANES, Operands, Simd, has_matrix_tiles};

/// Returns the lanes that `count` values along the inner dimension take, with the zeros at their end.
#[inline(always)]
pub(crate) fn lanes_of<S: Simd, O: Operands>(count: usize) -> usize {
    count.div_ceil(O::PER_LANE).next_multiple_of(if has_matrix_tiles::<S, O>() { MATRIX_LANES } else { 1 })
}

/// Packs rows along the inner dimension, one after the other: `to[row][lane]` with `width` lanes a row, zeros at the end.
#[inline(always)]
pub(crate) fn pack_rows<'a, S: Simd, O: Operands>(
    simd: S,
    rows: impl Iterator<Item = &'a [f32]>,
    width: usize,
    to: &mut [f32],
) {
    for (row, to) in rows.zip(to.chunks_exact_mut(width)) {
        for (i, to) in to.chunks_mut(S::LANES).enumerate() {
            simd.write(to, O::along(simd, row, i * S::LANES));
        }
    }
}

/// Packs the first `count` values of a row along the inner dimension in their own place, the lanes at the start.
#[inline(always)]
pub(crate) fn pack_in_place<S: Simd, O: Operands>(simd: S, row: &mut [f32], count: usize) {
    if O::PER_LANE > 1 {
        for start in (0..lanes_of::<S, O>(count)).step_by(S::LANES) {
            // Written where the values are read already.
            let packed = O::along(simd, &row[..count], start);
            simd.write(&mut row[start..], packed);
        }
    }
}

/// Packs rows across the inner dimension: `to[lane][column]` with `width` columns, zeros at the end.
#[inline(always)]
pub(crate) fn pack_across<'a, S: Simd, O: Operands>(
    simd: S,
    mut rows: impl Iterator<Item = &'a [f32]>,
    width: usize,
    to: &mut [f32],
) {
    for to in to.chunks_exact_mut(width) {
        let first = rows.next().unwrap_or_default();
        let second = if O::PER_LANE == 2 { rows.next().unwrap_or_default() } else { &[] };
        for (i, to) in to.chunks_mut(S::LANES).enumerate() {
            simd.write(to, O::across(simd, [first, second], i * S::LANES));
        }
    }
}

/// Packs rows across the inner dimension in panels: `to[panel][lane][column]` with `lanes` lanes and `width` columns a panel,
/// zeros at the end of the last one. Rows of one panel lie together in the cache.
#[inline(always)]
pub(crate) fn pack_panels<'a, S: Simd, O: Operands>(
    simd: S,
    rows: impl Iterator<Item = &'a [f32]> + Clone,
    [lanes, width]: [usize; 2],
    to: &mut [f32],
) {
    for (panel, to) in to.chunks_exact_mut(lanes * width).enumerate() {
        let columns = rows.clone().map(|row| row.get(panel * width..).unwrap_or_default());
        pack_across::<S, O>(simd, columns, width, to);
    }
}

/// Packs rows along the inner dimension as columns of panels: `to[panel][lane][column]` with `lanes` lanes and `width`
/// columns a panel, zeros at the end of the last one.
#[inline(always)]
pub(crate) fn pack_transposed<'a, S: Simd, O: Operands>(
    simd: S,
    mut rows: impl ExactSizeIterator<Item = &'a [f32]>,
    [lanes, width]: [usize; 2],
    to: &mut [f32],
) {
    for to in to.chunks_exact_mut(lanes * width) {
        let columns = width.min(rows.len());
        if columns < width {
            to.fill(0.0);
        }
        for first in (0..columns).step_by(S::LANES) {
            // Rows far apart in memory: several are read before the first is needed.
            let count = S::LANES.min(columns - first);
            let block: [&[f32]; MAX_LANES] =
                std::array::from_fn(|row| if row < count { rows.next().unwrap_or_default() } else { &[] });
            for start in (0..lanes).step_by(S::LANES) {
                // By a loop: the closure of `map` is compiled without the instruction set, a call per vector.
                let mut packed = [simd.splat(0.0); MAX_LANES];
                for (packed, row) in packed.iter_mut().zip(block).take(S::LANES) {
                    *packed = O::along(simd, row, start);
                }
                simd.transpose(&mut packed);
                for (lane, packed) in packed.iter().enumerate().take(S::LANES.min(lanes - start)) {
                    simd.write(&mut to[(start + lane) * width + first..][..count], *packed);
                }
            }
        }
    }
}
