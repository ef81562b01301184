//! Rectangular tiles of every view, the baseline of latent K-means (paper section 4.3, "patch-wise": "divides the image into
//! non-overlapping local patches, assigning tokens uniformly across regions").
//!
//! A view is halved along its longer side, and its parts likewise, until the number of tiles is reached. The centroid of a
//! tile is the token in its middle.
// N tokens, S tiles

use crate::error::ModelError;
use crate::tokens::clusters::SceneClusters;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Tile {
    row: usize,
    column: usize,
    rows: usize,
    columns: usize,
}

/// Groups the tokens of `num_views` views of `grid` rows and columns into exactly `num_tiles` rectangles.
///
/// All views have equally many tiles; the first views have one more if the division leaves a remainder.
///
/// # Shapes
/// - returns the groups of `num_views * rows * columns` tokens in the order view, row, column
pub(crate) fn tile_clusters(num_views: usize, grid: [usize; 2], num_tiles: usize) -> Result<SceneClusters, ModelError> {
    let [rows, columns] = grid;
    let num_tokens = num_views * rows * columns;
    if num_views == 0 || num_tiles < num_views || num_tiles > num_tokens {
        let reason = format!(
            "{num_tiles} tiles of {num_views} views of {rows} x {columns} tokens: use {num_views} to {num_tokens}"
        );
        return Err(ModelError::BadClusters { reason });
    }
    let mut assignment = vec![0; num_tokens];
    let mut centroid_index = Vec::with_capacity(num_tiles);
    for view in 0..num_views {
        let count = num_tiles / num_views + usize::from(view < num_tiles % num_views);
        let mut tiles = Vec::with_capacity(count);
        Tile { row: 0, column: 0, rows, columns }.divide(count, &mut tiles);
        let token = |row: usize, column: usize| (view * rows + row) * columns + column;
        for tile in tiles {
            let cluster = centroid_index.len() as u32;
            for row in tile.row..tile.row + tile.rows {
                assignment[token(row, tile.column)..token(row, tile.column) + tile.columns].fill(cluster);
            }
            centroid_index.push(token(tile.row + tile.rows / 2, tile.column + tile.columns / 2) as u32);
        }
    }
    SceneClusters::new(assignment, centroid_index)
}

impl Tile {
    /// Appends `count` tiles that cover this tile; `count` is between 1 and the number of tokens.
    fn divide(self, count: usize, into: &mut Vec<Self>) {
        if count == 1 {
            into.push(self);
            return;
        }
        let (long, short) = (self.rows.max(self.columns), self.rows.min(self.columns));
        // Half of the tiles, the same share of the longer side, and then as many tiles as both sides of the cut hold.
        let first = count / 2;
        let cut = ((long * first) as f64 / count as f64).round().clamp(1.0, (long - 1) as f64) as usize;
        let first = first.clamp(count.saturating_sub((long - cut) * short).max(1), (cut * short).min(count - 1));
        let (one, other) = if self.rows > self.columns {
            (Self { rows: cut, ..self }, Self { row: self.row + cut, rows: self.rows - cut, ..self })
        } else {
            (Self { columns: cut, ..self }, Self { column: self.column + cut, columns: self.columns - cut, ..self })
        };
        one.divide(first, into);
        other.divide(count - first, into);
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    #[test]
    fn every_count_gives_disjoint_rectangles_of_one_view_around_their_centroids() {
        for [rows, columns] in [[1, 1], [1, 7], [3, 3], [4, 6], [5, 2], [8, 8]] {
            for num_views in [1, 3] {
                for num_tiles in num_views..=num_views * rows * columns {
                    let clusters = tile_clusters(num_views, [rows, columns], num_tiles).unwrap();
                    assert_eq!(clusters.centroid_index().len(), num_tiles);
                    for (tile, &centroid) in clusters.centroid_index().iter().enumerate() {
                        let own =
                            clusters.assignment().iter().enumerate().filter(|(_, other)| **other as usize == tile);
                        let place = |token: usize| [token / (rows * columns), token / columns % rows, token % columns];
                        let places: BTreeSet<[usize; 3]> = own.map(|(token, _)| place(token)).collect();
                        let (first, last) = (places.first().unwrap(), places.last().unwrap());
                        let [views, height, width] = [0, 1, 2].map(|axis| last[axis] - first[axis] + 1);
                        assert_eq!((views, height * width), (1, places.len()), "{rows} x {columns}, {num_tiles}");
                        let middle = [first[0], first[1] + height / 2, first[2] + width / 2];
                        assert_eq!(place(centroid as usize), middle);
                    }
                }
            }
        }
    }

    #[test]
    fn counts_out_of_range_are_refused() {
        for count in [0, 1, 25] {
            let message = tile_clusters(2, [3, 4], count).unwrap_err().to_string();
            assert!(message.contains("use 2 to 24"), "{message}");
        }
    }
}
