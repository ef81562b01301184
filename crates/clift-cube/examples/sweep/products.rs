//! Products of the linear layers, forward and backward.

use clift_cube::{Matrices, MatrixShape, MatrixTile, Product, ProductTile, RegisterTile, Values};

use crate::Sizes;
use crate::inputs::{Input, read, samples};
use crate::measure::{Sweep, Work};

pub fn register_tiles() -> Vec<ProductTile> {
    [([128, 128, 16], [8, 8]), ([64, 128, 16], [4, 8]), ([64, 64, 16], [4, 4]), ([128, 128, 8], [8, 8])]
        .map(|(stage, unit)| ProductTile::Register(RegisterTile { stage, unit }))
        .into()
}

/// Returns the tiles of cooperative matrices, without such none.
pub fn matrix_tiles(shape: Option<MatrixShape>) -> Vec<ProductTile> {
    // Matrices of a stage, planes and buffers.
    let tiles: [([usize; 3], [usize; 2], usize); 11] = [
        ([8, 8, 2], [2, 4], 1),
        ([8, 8, 2], [2, 2], 1),
        ([8, 8, 2], [2, 4], 2),
        ([8, 8, 2], [2, 2], 2),
        ([8, 8, 4], [2, 2], 1),
        ([8, 8, 4], [2, 4], 1),
        ([16, 8, 2], [4, 2], 1),
        ([8, 16, 2], [2, 4], 1),
        ([8, 4, 2], [2, 2], 2),
        ([4, 8, 2], [2, 2], 2),
        ([4, 4, 2], [2, 2], 2),
    ];
    let tile = |shape: MatrixShape, (stage, planes, buffers): ([usize; 3], [usize; 2], usize)| {
        ProductTile::Matrix(MatrixTile { shape, stage: stage.map(|count| count * shape.sizes[0]), planes, buffers })
    };
    shape.into_iter().flat_map(|shape| tiles.map(|one| tile(shape, one))).collect()
}

/// A linear layer.
pub struct Layer {
    name: &'static str,
    /// Rows, outputs and inputs.
    sizes: [usize; 3],
}

impl Layer {
    pub fn all(sizes: Sizes) -> [Self; 5] {
        let (dim, hidden) = (sizes.dim(), sizes.feed_forward);
        let [tokens, queries] = [sizes.tokens, sizes.queries].map(|count| sizes.batch * count);
        [
            ("qkv", [tokens, 3 * dim, dim]),
            ("feed-forward 1", [tokens, hidden, dim]),
            ("feed-forward 2", [tokens, dim, hidden]),
            ("projection", [tokens, dim, dim]),
            ("qkv of queries", [queries, 3 * dim, dim]),
        ]
        .map(|(name, sizes)| Self { name, sizes })
    }

    /// Returns the forward, and the gradients of the inputs and of the weights.
    pub fn products(&self) -> [LayerProduct; 3] {
        let ([rows, outputs, inputs], name) = (self.sizes, self.name);
        [
            LayerProduct { name, part: "forward", sizes: [rows, outputs, inputs], transposed: [false, false] },
            LayerProduct { name, part: "input gradient", sizes: [rows, inputs, outputs], transposed: [false, true] },
            LayerProduct { name, part: "weight gradient", sizes: [inputs, outputs, rows], transposed: [true, false] },
        ]
    }
}

pub struct LayerProduct {
    name: &'static str,
    part: &'static str,
    /// M, N and K.
    sizes: [usize; 3],
    /// Layouts of the operands.
    transposed: [bool; 2],
}

impl LayerProduct {
    /// Runs tiles on operands in buffers of a type.
    pub fn run(&self, sweep: &mut Sweep, tiles: &[ProductTile], buffers: Values) {
        let ([m, n, k], [lhs_transposed, rhs_transposed]) = (self.sizes, self.transposed);
        let is_rounded = matches!(tiles.first(), Some(ProductTile::Matrix(_)));
        let input = |seed, len| {
            let input = Input::new(seed, len);
            if is_rounded { input.rounded(buffers) } else { input }
        };
        let (lhs, rhs) = (input(1, m * k), input(2, k * n));
        let lhs_at = |i: usize, t: usize| lhs.at(if lhs_transposed { t * m + i } else { i * k + t });
        let rhs_at = |t: usize, j: usize| rhs.at(if rhs_transposed { j * k + t } else { t * n + j });
        let client = sweep.client;
        let case = format!("{} {m}x{n}x{k}, {buffers:?}", self.name);
        for &tile in tiles {
            let launch = || {
                let view = |buffer, transposed, rows, columns| Matrices {
                    transposed,
                    ..Matrices::contiguous(buffer, if transposed { rows } else { columns })
                };
                let lhs = view(lhs.buffer(client), lhs_transposed, m, k);
                let rhs = view(rhs.buffer(client), rhs_transposed, k, n);
                vec![Product::new(lhs, rhs, self.sizes).run_tile(client, tile)]
            };
            sweep.run(
                &format!("product, {}", self.part),
                &case,
                &name(tile),
                Work::Flops(2.0 * (m * n * k) as f64),
                launch,
                |results| {
                    let mut pairs = Vec::new();
                    for i in samples(m, 4) {
                        let row = read(client, &results[0], i * n, n)?;
                        // Some million terms in all.
                        for j in samples(n, (1_000_000 / k).clamp(8, n)) {
                            pairs.push((row[j], (0..k).map(|t| lhs_at(i, t) * rhs_at(t, j)).sum()));
                        }
                    }
                    Ok(vec![pairs])
                },
            );
        }
    }
}

fn name(tile: ProductTile) -> String {
    match tile {
        ProductTile::Register(RegisterTile { stage: [m, n, k], unit: [rows, columns] }) => {
            format!("{m}x{n}x{k}, unit {rows}x{columns}")
        }
        ProductTile::Matrix(MatrixTile { stage: [m, n, k], planes: [rows, columns], buffers, .. }) => {
            format!("{m}x{n}x{k}, planes {rows}x{columns}, {buffers} buffers")
        }
    }
}
