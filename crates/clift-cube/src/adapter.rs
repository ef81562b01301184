//! What an adapter multiplies with, and the tiles chosen for it.

use cubecl::features::{MmaConfig, Plane};
use cubecl::prelude::*;
use half::f16;

use crate::buffer::Values;
use crate::matrix_product::{MatrixShape, MatrixTile};
use crate::matrix_scores::AttentionTile;
use crate::register_product::RegisterTile;

/// Class of an adapter.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum AdapterClass {
    /// Cooperative matrices with f16 operands and f32 sums.
    Matrices(MatrixShape),
    /// None.
    Registers,
}

impl AdapterClass {
    /// Returns the class of the client's adapter: matrices of 16 x 16 x 16, or of 8 x 8 x 8, or none.
    pub fn of(client: &Client) -> Self {
        let properties = client.properties();
        let hardware = &properties.hardware;
        let plane = hardware.plane_size_min as usize;
        if hardware.plane_size_max as usize != plane || !properties.features.plane.contains(Plane::Sync) {
            return Self::Registers;
        }
        let [half, single] = [f16::elem_type_native(), f32::elem_type_native()];
        let has = |size: u32| {
            let config = MmaConfig { a_type: half, b_type: half, cd_type: single, m: size, n: size, k: size };
            properties.features.matmul.cmma.contains(&config)
        };
        let size = [16, 8].into_iter().find(|&size| has(size) && plane.is_multiple_of(size as usize));
        size.map_or(Self::Registers, |size| Self::Matrices(MatrixShape { sizes: [size as usize; 3], plane }))
    }

    /// Returns the tile of a product with operands of a type.
    pub(crate) fn product_tile(self, operands: Values, [m, n, _k]: [usize; 3]) -> ProductTile {
        match self {
            Self::Matrices(shape) if operands == Values::F16 => {
                // Matrices of 8 x 8 x 8 are software's.
                let (stage, planes) = match (shape.sizes[0], m.min(n)) {
                    (16, 96..) => ([128, 128, 32], [2, 4]),
                    (16, _) => ([64, 64, 32], [2, 2]),
                    _ => ([32, 32, 16], [2, 2]),
                };
                ProductTile::Matrix(MatrixTile { shape, stage, planes })
            }
            _ if m.min(n) >= 96 => ProductTile::Register(RegisterTile { stage: [128, 128, 16], unit: [8, 8] }),
            _ => ProductTile::Register(RegisterTile { stage: [64, 64, 16], unit: [4, 4] }),
        }
    }

    /// Returns the tiles of attention, forward and backward, with operands of a type; `None` for register tiles, which have one.
    pub(crate) fn attention_tiles(self, operands: Values, width: usize) -> [Option<AttentionTile>; 2] {
        let Self::Matrices(shape) = self else { return [None; 2] };
        let (planes, columns) = if shape.sizes[0] == 16 { ([8, 4], 32) } else { ([4, 4], 16) };
        planes.map(|planes| (operands == Values::F16).then_some(AttentionTile { shape, planes, columns, width }))
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
