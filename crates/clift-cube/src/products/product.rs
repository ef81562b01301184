//! Matrix products: batched, of transposed operands, of any sizes.
// M rows, N columns, K terms of a sum

use cubecl::ir::ElemType;
use cubecl::prelude::*;

use crate::buffers::buffer::{Buffer, Matrices, Values};
use crate::buffers::load::{Four, LinesLaunch};
use crate::ledger::count_products;
use crate::products::epilogue::{Epilogue, write_four};
use crate::products::matrix_product::matrix_product;
use crate::products::product_kind::{ProductKind, SizesLaunch};
use crate::products::register_product::register_product;
use crate::products::tiles::{ProductTile, product_tile};

/// Most tiles of an output whose long sums are split, so that all processors of the adapter have work: an H100 has 132, each
/// with room for several tiles.
const FEW_TILES: usize = 128;
/// Tiles and splits of such an output.
const MIN_TILES: usize = 384;
/// Fewest stages of a split.
const MIN_STAGES: usize = 16;

/// A product `lhs rhs` of batches of matrices: `[M, K]` by `[K, N]`, the output `[batch, M, N]`.
#[derive(Clone, Debug)]
pub struct Product<'a> {
    /// Left matrices.
    pub lhs: Matrices<'a>,
    /// Right matrices.
    pub rhs: Matrices<'a>,
    /// Number of matrices of the output.
    pub batch: usize,
    /// M, N and K.
    pub sizes: [usize; 3],
    /// Type to which operands are rounded, on adapters with cooperative matrices; sums are in f32.
    pub operands: Values,
    /// Added to every row of the sums: `[N]` in f32.
    pub bias: Option<&'a Buffer>,
    /// Applies GELU after the bias.
    pub gelu: bool,
    /// Added last, in f32, in the layout of the output.
    pub residual: Option<&'a Buffer>,
    /// Type of the output.
    pub output: Values,
}

impl<'a> Product<'a> {
    /// Returns a product of single matrices in f32, without further steps.
    pub fn new(lhs: Matrices<'a>, rhs: Matrices<'a>, sizes: [usize; 3]) -> Self {
        let [operands, output] = [Values::F32; 2];
        Self { lhs, rhs, batch: 1, sizes, operands, bias: None, gelu: false, residual: None, output }
    }

    /// Computes the product into a new buffer, with the adapter's tile of the table.
    pub fn run(&self, client: &Client) -> Buffer {
        let terms_inner = [!self.lhs.transposed, self.rhs.transposed];
        self.run_tile(client, product_tile(client, self.operands, self.batch, self.sizes, terms_inner))
    }

    /// Computes the product with a tile, which decides the type of the operands.
    pub fn run_tile(&self, client: &Client, tile: ProductTile) -> Buffer {
        let [m, n, _] = self.sizes;
        let output = Buffer::empty(client, self.batch * m * n, self.output);
        if output.len == 0 {
            return output;
        }
        let epilogue = Epilogue { bias: self.bias.is_some(), gelu: self.gelu, residual: self.residual.is_some() };
        let splits = self.splits(tile);
        if splits.count == 1 {
            self.launch(client, tile, splits, epilogue, &output);
        } else {
            let partial = Buffer::empty(client, splits.count * output.len, Values::F32);
            self.launch(client, tile, splits, Epilogue::default(), &partial);
            self.add_splits(client, &partial, splits.count, epilogue, &output);
        }
        output
    }

    /// Divides long sums of few tiles.
    fn splits(&self, tile: ProductTile) -> Splits {
        let ([m, n, k], [tile_m, tile_n, tile_k]) = (self.sizes, tile.stage());
        let tiles = self.batch * m.div_ceil(tile_m) * n.div_ceil(tile_n);
        let wanted = if tiles > FEW_TILES { 1 } else { MIN_TILES.div_ceil(tiles) };
        let count = wanted.min(k.div_ceil(tile_k * MIN_STAGES)).max(1);
        let terms = k.div_ceil(count).next_multiple_of(tile_k);
        Splits { count: k.div_ceil(terms).max(1), terms }
    }

    fn launch(&self, client: &Client, tile: ProductTile, splits: Splits, epilogue: Epilogue, output: &Buffer) {
        let [m, n, k] = self.sizes;
        count_products(self.batch, [m, n, k]);
        let kind = ProductKind { terms_inner: [!self.lhs.transposed, self.rhs.transposed], epilogue };
        let [lhs_width, rhs_width] = [self.lhs.width([m, k]), self.rhs.width([k, n])];
        let output_width = if n.is_multiple_of(4) { 4 } else { 1 };
        let lines = |x: &Matrices| LinesLaunch::new(x.start, x.batch_stride, x.stride);
        let [tile_m, tile_n, _] = tile.stage();
        let cubes = [n.div_ceil(tile_n), m.div_ceil(tile_m), self.batch * splits.count].map(|count| count as u32);
        let count = CubeCount::Static(cubes[0], cubes[1], cubes[2]);
        let dim = CubeDim::new_1d(tile.units() as u32);
        let [lhs, rhs] = [self.lhs.buffer.arg(lhs_width), self.rhs.buffer.arg(rhs_width)];
        // A kernel without bias or residual reads nothing of these.
        let unused = self.lhs.buffer;
        let bias = self.bias.filter(|_| epilogue.bias).unwrap_or(unused).arg(1);
        let residual = self.residual.filter(|_| epilogue.residual).unwrap_or(unused).arg(output_width);
        let (lhs_lines, rhs_lines) = (lines(&self.lhs), lines(&self.rhs));
        let sizes = SizesLaunch::new(m, n, k, splits.count, splits.terms);
        let types = [self.lhs.buffer.values, self.rhs.buffer.values, output.values].map(Values::elem);
        let widths = [lhs_width, rhs_width, output_width];
        let output = output.arg(output_width);
        // SAFETY: the kernels read inside the limits of the matrices and write inside the output.
        unsafe {
            match tile {
                ProductTile::Register(tile) => register_product::launch_unchecked(
                    client, count, dim, widths[0], widths[1], widths[2], lhs, rhs, bias, residual, output, lhs_lines,
                    rhs_lines, sizes, kind, tile, types,
                ),
                ProductTile::Matrix(tile) => matrix_product::launch_unchecked(
                    client, count, dim, widths[0], widths[1], widths[2], lhs, rhs, bias, residual, output, lhs_lines,
                    rhs_lines, sizes, kind, tile, types,
                ),
            }
        }
    }

    fn add_splits(&self, client: &Client, partial: &Buffer, splits: usize, epilogue: Epilogue, output: &Buffer) {
        let [m, n, _] = self.sizes;
        let width = if n.is_multiple_of(4) { 4 } else { 1 };
        let units = 64;
        let rows = self.batch * m;
        let unused = partial;
        // SAFETY: the kernel compares row and column with the sizes.
        unsafe {
            add_splits::launch_unchecked(
                client,
                CubeCount::Static(n.div_ceil(4 * units) as u32, rows as u32, 1),
                CubeDim::new_1d(units as u32),
                width,
                partial.arg(width),
                self.bias.unwrap_or(unused).arg(1),
                self.residual.unwrap_or(unused).arg(width),
                output.arg(width),
                m,
                n,
                splits,
                epilogue,
                output.values.elem(),
            );
        }
    }
}

/// Splits of the sums, and terms of each.
#[derive(Clone, Copy)]
struct Splits {
    count: usize,
    terms: usize,
}

/// Adds the splits `[batch, splits, M, N]` in their order.
#[cube(launch_unchecked)]
fn add_splits<O: Float, V: Size>(
    partial: &[Vector<f32, V>],
    bias: &[f32],
    residual: &[Vector<f32, V>],
    output: &mut [Vector<O, V>],
    rows: usize,
    columns: usize,
    splits: usize,
    #[comptime] epilogue: Epilogue,
    #[define(O)] _values: ElemType,
) {
    let width = V::value().comptime();
    let row = CUBE_POS_Y as usize;
    let column = (CUBE_POS_X as usize * CUBE_DIM as usize + UNIT_POS as usize) * 4;
    let mut sum = Four::<f32>::new(0.0);
    for split in 0..splits {
        let start = ((row / rows * splits + split) * rows + row % rows) * columns;
        if comptime!(width == 4) {
            if column < columns {
                sum += Four::<f32>::cast_from(partial[(start + column) / 4]);
            }
        } else {
            #[unroll]
            for i in 0..4usize {
                if column + i < columns {
                    sum.insert(i, sum.extract(i) + partial[start + column + i].extract(0usize));
                }
            }
        }
    }
    write_four::<O, V>(output, bias, residual, sum, 0usize, row, column, row + 1, columns, epilogue);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::products::matrix_product::MatrixTile;
    use crate::products::register_product::RegisterTile;
    use crate::testing::cases::product;
    use crate::testing::{check, client, matrix_client};

    /// Checks a product with every step.
    fn check_product(
        client: &Client,
        tile: ProductTile,
        sizes: [usize; 3],
        batch: usize,
        transposed: [bool; 2],
        types: [Values; 3],
    ) {
        let tolerance = if types[2] == Values::F16 { 6e-4 } else { 3e-7 * (sizes[2] as f64).sqrt().max(8.0) };
        check(client, &product(tile, sizes, batch, transposed, types, false), tolerance);
    }

    const BOTH: [[bool; 2]; 4] = [[false, false], [true, false], [false, true], [true, true]];

    #[test]
    fn register_tiles_equal_f64() {
        let Some(client) = client() else { return };
        let small = ProductTile::Register(RegisterTile { stage: [64, 64, 16], unit: [4, 4] });
        let large = ProductTile::Register(RegisterTile { stage: [128, 128, 16], unit: [8, 8] });
        let f32 = [Values::F32; 3];
        for transposed in BOTH {
            check_product(&client, small, [65, 68, 36], 2, transposed, f32);
            check_product(&client, small, [3, 7, 1], 1, transposed, f32);
        }
        check_product(&client, large, [130, 129, 40], 1, [false, true], f32);
        // Few tiles and long sums: splits.
        check_product(&client, small, [12, 70, 1030], 2, [true, false], f32);
        check_product(&client, small, [20, 24, 33], 1, [false, false], [Values::F16, Values::F32, Values::F16]);
    }

    #[test]
    fn matrix_tiles_equal_f64_of_rounded_operands() {
        let Some((client, shape)) = matrix_client() else { return };
        let tile = |buffers| {
            let [m, n, k] = shape.sizes;
            ProductTile::Matrix(MatrixTile { shape, stage: [2 * m, 4 * n, 2 * k], planes: [2, 2], buffers })
        };
        let small = tile(2);
        for transposed in BOTH {
            check_product(&client, tile(1), [65, 68, 36], 2, transposed, [Values::F32; 3]);
            check_product(&client, small, [3, 7, 1], 1, transposed, [Values::F16, Values::F32, Values::F32]);
            check_product(&client, small, [24, 40, 64], 1, transposed, [Values::F16; 3]);
        }
        check_product(&client, small, [12, 70, 1030], 2, [true, false], [Values::F32; 3]);
        let table = product_tile(&client, Values::F16, 1, [256, 256, 64], [true, false]);
        check_product(&client, table, [96, 100, 72], 1, [false, true], [Values::F32, Values::F16, Values::F16]);
    }
}
