//! Matrix products with bf16 operands and f32 sums.
// C[M, N] = A[M, K] B[K, N]

use rayon::prelude::*;

use crate::primitives::matmul::{Left, Right, multiply, padded, panel_width};
use crate::primitives::packing::{lanes_of, pack_across, pack_rows, pack_transposed};
use crate::primitives::scratch::Scratch;
use crate::simd::dispatch::{InstructionSet, Kernel, OperandType};
use crate::simd::vector::{MATRIX_ROWS, Operands, Simd};

/// Values along the inner dimension that are multiplied before the next ones. A panel of B takes 48 KB of the L2 cache, which
/// reads it in less time than the tile multiplies; larger blocks read and write the sums less often.
const INNER_BLOCK: usize = 768;
/// Most rows of a task: its part of A stays in the L2 cache.
const ROW_BLOCK: usize = 96;
/// Fewest rows of a task, those of a matrix tile: every task reads the whole of B.
const FEWEST_ROWS: usize = MATRIX_ROWS;

/// A matrix in a slice. Its rows are contiguous, or its columns if it is `transposed`.
#[derive(Clone, Copy, Debug)]
pub struct Matrix<'a> {
    /// Values, `[rows, columns]`, or `[columns, rows]` if `transposed`.
    pub values: &'a [f32],
    /// Whether the columns are contiguous.
    pub transposed: bool,
}

/// Computes `output[M, N] = a[M, K] b[K, N]`, plus a bias `[N]` per row. Values of `a` and `b` are rounded to bf16; sums are
/// f32.
pub fn matmul_bf16(
    set: InstructionSet,
    [rows, inner, columns]: [usize; 3],
    [a, b]: [Matrix<'_>; 2],
    bias: Option<&[f32]>,
    output: &mut [f32],
) {
    assert_eq!(a.values.len(), rows * inner, "a is [rows, inner]");
    assert_eq!(b.values.len(), inner * columns, "b is [inner, columns]");
    assert_eq!(output.len(), rows * columns, "output is [rows, columns]");
    assert!(bias.is_none_or(|bias| bias.len() == columns), "bias is [columns]");
    if output.is_empty() {
        return;
    }
    let mut sizes = [0; 2];
    set.run_product(OperandType::Bf16, PanelSizes { inner: inner.min(INNER_BLOCK), to: &mut sizes });
    let [lanes, width] = sizes;
    let layout = PackedB { lanes, width, num_panels: columns.div_ceil(width) };
    let mut packed = vec![0.0; layout.panel_len() * layout.num_panels * inner.div_ceil(INNER_BLOCK)];
    if !packed.is_empty() {
        packed.par_chunks_mut(layout.panel_len()).enumerate().for_each(|(i, to)| {
            let index = [i / layout.num_panels, i % layout.num_panels];
            set.run_product(OperandType::Bf16, PackPanel { b, inner, columns, layout, index, to });
        });
    }
    let block = rows.div_ceil(4 * rayon::current_num_threads()).next_multiple_of(FEWEST_ROWS).min(ROW_BLOCK);
    output.par_chunks_mut(block * columns).enumerate().for_each(|(i, to)| {
        let sizes = [rows, inner, columns];
        set.run_product(OperandType::Bf16, RowBlock { a, packed: &packed, layout, sizes, first: i * block, bias, to });
    });
}

/// The packed B: blocks along the inner dimension of panels of columns, `[block][panel][lane][column]`.
#[derive(Clone, Copy)]
struct PackedB {
    lanes: usize,
    width: usize,
    num_panels: usize,
}

impl PackedB {
    fn panel_len(&self) -> usize {
        self.lanes * self.width
    }
}

/// Where the lanes of a block of the inner dimension and the width of a panel are written.
struct PanelSizes<'a> {
    inner: usize,
    to: &'a mut [usize; 2],
}

impl Kernel for PanelSizes<'_> {
    #[inline(always)]
    fn run<S: Simd, O: Operands>(self, _simd: S) {
        *self.to = [lanes_of::<S, O>(self.inner), panel_width::<S>()];
    }
}

struct PackPanel<'a> {
    b: Matrix<'a>,
    inner: usize,
    columns: usize,
    layout: PackedB,
    index: [usize; 2],
    to: &'a mut [f32],
}

impl Kernel for PackPanel<'_> {
    #[inline(always)]
    fn run<S: Simd, O: Operands>(self, simd: S) {
        let Self { b, inner, columns, layout, index: [block, panel], to } = self;
        let inside = range(block, INNER_BLOCK, inner);
        let across = range(panel, layout.width, columns);
        if b.transposed {
            let rows = across.map(|column| &b.values[column * inner..][inside.clone()]);
            pack_transposed::<S, O>(simd, rows, [layout.lanes, layout.width], to);
        } else {
            let rows = inside.map(|row| &b.values[row * columns..][across.clone()]);
            pack_across::<S, O>(simd, rows, layout.width, to);
        }
    }
}

struct RowBlock<'a> {
    a: Matrix<'a>,
    packed: &'a [f32],
    layout: PackedB,
    sizes: [usize; 3],
    first: usize,
    bias: Option<&'a [f32]>,
    to: &'a mut [f32],
}

impl Kernel for RowBlock<'_> {
    #[inline(always)]
    fn run<S: Simd, O: Operands>(self, simd: S) {
        let Self { a, packed, layout, sizes: [rows, inner, columns], first, bias, to } = self;
        let (count, whole) = (to.len() / columns, padded::<S>(columns));
        let a_width = if a.transposed { padded::<S>(count) } else { layout.lanes };
        let a_len = a_width * if a.transposed { layout.lanes } else { count };
        // The register tile writes whole vectors.
        let in_place = whole == columns;
        let lens = [a_len, if in_place { 0 } else { count * whole }];
        let mut scratch = Scratch::take(lens.iter().sum());
        let [left, sums] = scratch.cut(lens);
        let result = if in_place { &mut *to } else { &mut *sums };
        // Without a bias the first block overwrites what is there.
        let starts_filled = bias.is_some() || inner == 0;
        if starts_filled {
            let bias = bias.unwrap_or_default();
            for row in result.chunks_exact_mut(whole) {
                row[..bias.len()].copy_from_slice(bias);
                row[bias.len()..].fill(0.0);
            }
        }
        for block in 0..inner.div_ceil(INNER_BLOCK) {
            let inside = range(block, INNER_BLOCK, inner);
            let lanes = lanes_of::<S, O>(inside.len());
            if a.transposed {
                let rows = inside.map(|row| &a.values[row * rows..][first..first + count]);
                pack_across::<S, O>(simd, rows, a_width, left);
            } else {
                let rows = (first..first + count).map(|row| &a.values[row * inner..][inside.clone()]);
                pack_rows::<S, O>(simd, rows, a_width, left);
            }
            let (row, step) = if a.transposed { (1, a_width) } else { (a_width, 1) };
            let panels = &packed[block * layout.num_panels * layout.panel_len()..];
            let right = Right { values: panels, step: layout.width, panel: layout.panel_len() };
            let left = Left { values: left, row, step };
            let accumulate = starts_filled || block > 0;
            multiply::<S, O>(simd, [count, lanes, columns], left, right, (result, whole), accumulate);
        }
        if !in_place {
            for (to, row) in to.chunks_exact_mut(columns).zip(sums.chunks_exact(whole)) {
                to.copy_from_slice(&row[..columns]);
            }
        }
    }
}

fn range(index: usize, size: usize, len: usize) -> std::ops::Range<usize> {
    index * size..(index * size + size).min(len)
}

#[cfg(test)]
mod tests {
    use half::bf16;

    use super::*;
    use crate::testing::{assert_close, random};

    fn transpose(values: &[f32], [rows, columns]: [usize; 2]) -> Vec<f32> {
        (0..rows * columns).map(|i| values[i % rows * columns + i / rows]).collect()
    }

    #[test]
    fn results_equal_f64_products_of_rounded_values() {
        for [rows, inner, columns] in
            [[1, 1, 1], [3, 5, 7], [70, 33, 129], [1, 768, 5], [130, 601, 96], [97, 256, 64], [30, 1600, 70]]
        {
            let (a, b, bias) = (random(rows * inner, 1), random(inner * columns, 2), random(columns, 3));
            let rounded = |values: &[f32]| values.iter().map(|&x| bf16::from_f32(x).to_f64()).collect::<Vec<_>>();
            let (wide_a, wide_b) = (rounded(&a), rounded(&b));
            let product = |i: usize| -> f64 {
                (0..inner).map(|k| wide_a[i / columns * inner + k] * wide_b[k * columns + i % columns]).sum()
            };
            let plain: Vec<f64> = (0..rows * columns).map(product).collect();
            let biased: Vec<f64> = plain.iter().zip(bias.iter().cycle()).map(|(sum, &b)| sum + f64::from(b)).collect();
            let (a_t, b_t) = (transpose(&a, [rows, inner]), transpose(&b, [inner, columns]));
            for (set, transposed) in InstructionSet::available().flat_map(|set| (0..4).map(move |i| (set, i))) {
                let a = Matrix { values: if transposed & 1 > 0 { &a_t } else { &a }, transposed: transposed & 1 > 0 };
                let b = Matrix { values: if transposed & 2 > 0 { &b_t } else { &b }, transposed: transposed & 2 > 0 };
                for (bias, expected) in [(None, &plain), (Some(&bias[..]), &biased)] {
                    let mut output = vec![f32::NAN; rows * columns];
                    matmul_bf16(set, [rows, inner, columns], [a, b], bias, &mut output);
                    assert_close(&output, expected, 1e-6);
                }
            }
        }
    }

    #[test]
    fn an_empty_sum_is_the_bias_and_infinities_propagate() {
        let matrix = |values| Matrix { values, transposed: false };
        for set in InstructionSet::available() {
            let mut output = [f32::NAN; 4];
            matmul_bf16(set, [2, 0, 2], [matrix(&[]); 2], Some(&[1.0, 2.0]), &mut output);
            assert_eq!(output, [1.0, 2.0, 1.0, 2.0]);
            matmul_bf16(set, [2, 0, 2], [matrix(&[]); 2], None, &mut output);
            assert_eq!(output, [0.0; 4]);
            let factors = [matrix(&[1.0]), matrix(&[f32::NAN, f32::INFINITY, f32::MAX])];
            matmul_bf16(set, [1, 1, 3], factors, None, &mut output[..3]);
            // The largest values of f32 are above those of bf16.
            assert!(output[0].is_nan() && output[1..3] == [f32::INFINITY; 2]);
        }
    }
}
