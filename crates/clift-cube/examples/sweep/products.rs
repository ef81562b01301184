//! Products of the linear layers, forward and backward.

use clift_cube::{MatrixShape, MatrixTile, ProductTile, RegisterTile, Values};

use crate::Sizes;
use crate::cases::product;
use crate::measure::Sweep;

/// Returns the tiles of registers with their names.
pub fn register_tiles() -> Vec<(String, ProductTile)> {
    [([128, 128, 16], [8, 8]), ([64, 128, 16], [4, 8]), ([64, 64, 16], [4, 4]), ([128, 128, 8], [8, 8])]
        .map(|(stage, unit)| named(ProductTile::Register(RegisterTile { stage, unit })))
        .into()
}

/// Returns the tiles of cooperative matrices with their names, without such none.
pub fn matrix_tiles(shape: Option<MatrixShape>) -> Vec<(String, ProductTile)> {
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
        let stage = stage.map(|count| count * shape.sizes[0]);
        named(ProductTile::Matrix(MatrixTile { shape, stage, planes, buffers }))
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
    pub fn run(&self, sweep: &mut Sweep, tiles: &[(String, ProductTile)], buffers: Values) {
        let [m, n, k] = self.sizes;
        let case = format!("{} {m}x{n}x{k}, {buffers:?}", self.name);
        let flops = 2.0 * (m * n * k) as f64;
        sweep.run(&format!("product, {}", self.part), &case, flops, tiles, |tile, is_small| {
            // Long sums of few tiles are split.
            let sizes = if is_small { [136, 132, 1100] } else { self.sizes };
            product(tile, sizes, 1, self.transposed, [buffers, buffers, Values::F32], true)
        });
    }
}

fn named(tile: ProductTile) -> (String, ProductTile) {
    let name = match tile {
        ProductTile::Register(RegisterTile { stage: [m, n, k], unit: [rows, columns] }) => {
            format!("{m}x{n}x{k}, unit {rows}x{columns}")
        }
        ProductTile::Matrix(MatrixTile { stage: [m, n, k], planes: [rows, columns], buffers, .. }) => {
            format!("{m}x{n}x{k}, planes {rows}x{columns}, {buffers} buffers")
        }
    };
    (name, tile)
}
