//! Tiles of products, and the table of tiles by adapter and sizes.

use cubecl::prelude::Client;

use crate::adapter::AdapterClass;
use crate::buffers::buffer::Values;
use crate::products::matrix_product::MatrixTile;
use crate::products::register_product::RegisterTile;

/// Tiles of an output for which the largest tiles leave work for all processors: an H100 has 132.
const MANY_TILES: usize = 256;

/// Returns the tile of a product of an adapter with operands of a type. `batch` counts matrices of `sizes` M, N and K; terms lie
/// side by side in the operands of `terms_inner`. Measured on an H100 by `examples/sweep`.
pub(crate) fn product_tile(
    client: &Client,
    operands: Values,
    batch: usize,
    sizes: [usize; 3],
    terms_inner: [bool; 2],
) -> ProductTile {
    let [m, n, _] = sizes;
    let shape = match AdapterClass::of(client) {
        AdapterClass::Matrices(shape) if operands == Values::F16 => shape,
        _ if m.min(n) >= 96 => return ProductTile::Register(RegisterTile { stage: [64, 128, 16], unit: [4, 8] }),
        _ => return ProductTile::Register(RegisterTile { stage: [64, 64, 16], unit: [4, 4] }),
    };
    let tile = |stage, planes, buffers| MatrixTile { shape, stage, planes, buffers };
    let tiles = if shape.sizes[0] == 16 {
        let largest = match terms_inner {
            [false, _] => tile([256, 128, 32], [4, 2], 1),
            [true, false] => tile([128, 256, 32], [2, 4], 1),
            [true, true] => tile([128, 128, 64], [2, 4], 1),
        };
        let middle = [2, 1].map(|buffers| tile([128, 128, 32], [2, 4], buffers));
        [largest, middle[0], middle[1], tile([64, 64, 32], [2, 2], 1)]
    } else {
        // Matrices of 8 x 8 x 8 (Mesa's software Vulkan) get the smallest tile.
        [tile([32, 32, 16], [2, 2], 1); 4]
    };
    let shared_bytes = client.properties().hardware.max_shared_memory_size;
    let fits = |tile: &&MatrixTile| {
        let ([rows, columns, _], smallest) = (tile.stage, tiles[3]);
        let count = batch * m.div_ceil(rows) * n.div_ceil(columns);
        // Few tiles of long sums are split.
        let is_enough = **tile != tiles[0] || count >= MANY_TILES || !terms_inner[0];
        **tile == smallest || (m.min(n) >= 96 && is_enough && tile.shared_bytes() <= shared_bytes)
    };
    ProductTile::Matrix(*tiles.iter().find(fits).unwrap_or(&tiles[3]))
}

/// Tile of a product.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ProductTile {
    /// Sums in registers, in f32.
    Register(RegisterTile),
    /// Cooperative matrices, of operands in f16.
    Matrix(MatrixTile),
}

impl ProductTile {
    /// Rows, columns and terms of a stage.
    pub(crate) fn stage(self) -> [usize; 3] {
        match self {
            Self::Register(tile) => tile.stage,
            Self::Matrix(tile) => tile.stage,
        }
    }

    pub(crate) fn units(self) -> usize {
        match self {
            Self::Register(tile) => tile.num_units(),
            Self::Matrix(tile) => tile.num_planes() * tile.shape.plane,
        }
    }
}
