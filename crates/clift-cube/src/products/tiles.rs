//! Tiles of products, and the table of tiles by adapter and sizes.

use crate::adapter::AdapterClass;
use crate::buffers::buffer::Values;
use crate::products::matrix_product::MatrixTile;
use crate::products::register_product::RegisterTile;

impl AdapterClass {
    /// Returns the tile of a product with operands of a type.
    pub(crate) fn product_tile(self, operands: Values, [m, n, _k]: [usize; 3]) -> ProductTile {
        match self {
            Self::Matrices(shape) if operands == Values::F16 => {
                // Matrices of 8 x 8 x 8 (Mesa's software Vulkan) get the smallest tile.
                let (stage, planes) = match (shape.sizes[0], m.min(n)) {
                    (16, 96..) => ([128, 128, 32], [2, 4]),
                    (16, _) => ([64, 64, 32], [2, 2]),
                    _ => ([32, 32, 16], [2, 2]),
                };
                ProductTile::Matrix(MatrixTile { shape, stage, planes, buffers: 1 })
            }
            _ if m.min(n) >= 96 => ProductTile::Register(RegisterTile { stage: [128, 128, 16], unit: [8, 8] }),
            _ => ProductTile::Register(RegisterTile { stage: [64, 64, 16], unit: [4, 4] }),
        }
    }
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
