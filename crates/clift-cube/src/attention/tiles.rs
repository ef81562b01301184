//! Table of the tiles of attention by adapter.

use crate::adapter::AdapterClass;
use crate::attention::matrix_scores::AttentionTile;
use crate::buffers::buffer::Values;

impl AdapterClass {
    /// Returns the tiles of attention, forward and backward, with operands of a type; `None` stands for register tiles.
    pub(crate) fn attention_tiles(self, operands: Values, width: usize) -> [Option<AttentionTile>; 2] {
        let Self::Matrices(shape) = self else { return [None; 2] };
        let (planes, columns) = if shape.sizes[0] == 16 { ([8, 4], 32) } else { ([4, 4], 16) };
        planes.map(|planes| (operands == Values::F16).then_some(AttentionTile { shape, planes, columns, width }))
    }
}
