//! Table of the tiles of attention by adapter.

use cubecl::prelude::Client;

use crate::adapter::AdapterClass;
use crate::attention::matrix_scores::AttentionTile;
use crate::buffers::buffer::Values;

/// Returns the tiles of attention of an adapter, forward and backward, with operands of a type; `None` stands for register
/// tiles.
pub fn attention_tiles(client: &Client, operands: Values, width: usize) -> [Option<AttentionTile>; 2] {
    let AdapterClass::Matrices(shape) = AdapterClass::of(client) else { return [None; 2] };
    if operands != Values::F16 {
        return [None; 2];
    }
    let shared_bytes = client.properties().hardware.max_shared_memory_size;
    let (most_planes, columns) = if shape.sizes[0] == 16 { ([8, 4], 32) } else { ([4, 4], 16) };
    [0, 1].map(|i| {
        let tiles = [8, 4, 2, 1].map(|planes| AttentionTile { shape, planes, columns, width });
        let fits = |tile: &AttentionTile| tile.planes <= most_planes[i] && tile.shared_bytes() <= shared_bytes;
        tiles.into_iter().find(fits)
    })
}
