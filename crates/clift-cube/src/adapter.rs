//! Matrix instructions of an adapter.

use cubecl::features::{MmaConfig, Plane};
use cubecl::prelude::*;
use half::f16;

/// Shape of the cooperative matrices of an adapter: f16 operands, f32 sums.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct MatrixShape {
    /// M, N, K.
    pub sizes: [usize; 3],
    /// Units of a plane.
    pub plane: usize,
}

/// Class of an adapter.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum AdapterClass {
    /// Cooperative matrices with f16 operands and f32 sums. Such adapters also have plane operations, which `CubeCL` does
    /// not report for software.
    Matrices(MatrixShape),
    /// No cooperative matrices: sums in registers, in f32.
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
}
