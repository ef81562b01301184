//! Patch-wise grouping: rectangular tiles of every view, what latent K-means is measured against (paper section 4.3).
//!
//! "Divides the image into non-overlapping local patches, assigning tokens uniformly across regions": the tiles of a
//! view are its halves, halved again along their longer side until there are as many as asked for, and the token in
//! the middle of a tile stands for it.
// N tokens, S tiles

use serde::{Deserialize, Serialize};

use crate::error::ModelError;
use crate::tokens::clusters::SceneClusters;

/// How the tokens of a scene are put into groups.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Grouping {
    /// Latent K-means: the method.
    #[default]
    Kmeans,
    /// Tiles of every view: the paper's baseline.
    Tile,
}

/// Rows and columns of a view's tokens that a tile covers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Tile {
    row: usize,
    column: usize,
    rows: usize,
    columns: usize,
}

/// Tiles the tokens of `num_views` views of `grid` rows and columns into exactly `num_tiles` rectangles.
///
/// Views share the tiles evenly, the first ones get one more where that leaves a rest. The tiles of a view differ in
/// size by as little as halving allows, and are as square as that.
///
/// # Shapes
/// - returns the groups of `num_views * rows * columns` tokens in the order view, row, column
///
/// # Errors
/// [`ModelError::BadClusters`] for fewer tiles than views, whose tokens would belong nowhere, and for more tiles than
/// tokens.
pub fn tile_clusters(num_views: usize, grid: [usize; 2], num_tiles: usize) -> Result<SceneClusters, ModelError> {
    let [rows, columns] = grid;
    let num_tokens = num_views * rows * columns;
    if num_views == 0 || num_tiles < num_views || num_tiles > num_tokens {
        let what = format!(
            "{num_tiles} tiles of {num_views} views of {rows} x {columns} tokens: use {num_views} to {num_tokens}"
        );
        return Err(ModelError::BadClusters { what });
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
    /// Appends `count` tiles that cover this one, row by row of the halves; `count` is 1 up to its tokens.
    fn divide(self, count: usize, into: &mut Vec<Self>) {
        if count == 1 {
            into.push(self);
            return;
        }
        let (long, short) = (self.rows.max(self.columns), self.rows.min(self.columns));
        // The share of the tiles that the first half gets, then the share of the side that this is, then as many
        // tiles as fit both sides of the cut.
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

    /// Rows and columns that a cluster spans in its view, and its tokens.
    fn spans(clusters: &SceneClusters, grid: [usize; 2]) -> Vec<([usize; 2], Vec<usize>)> {
        let of = |cluster: usize| {
            let assignment = clusters.assignment().iter().enumerate();
            let tokens: Vec<usize> = assignment.filter(|(_, own)| **own as usize == cluster).map(|(t, _)| t).collect();
            let span = |place: fn(usize, [usize; 2]) -> usize| {
                let places: BTreeSet<usize> = tokens.iter().map(|&token| place(token, grid)).collect();
                places.last().unwrap() - places.first().unwrap() + 1
            };
            ([span(|t, [r, c]| t / c % r), span(|t, [_, c]| t % c)], tokens)
        };
        (0..clusters.centroid_index().len()).map(of).collect()
    }

    #[test]
    fn sixteen_tiles_of_four_views_are_squares_with_the_token_in_the_middle() {
        let clusters = tile_clusters(4, [8, 8], 16).unwrap();
        assert!(spans(&clusters, [8, 8]).iter().all(|(span, tokens)| *span == [4, 4] && tokens.len() == 16));
        // Of the first view: tokens (2, 2), (2, 6), (6, 2), (6, 6), in some order.
        let first: BTreeSet<u32> = clusters.centroid_index()[..4].iter().copied().collect();
        assert_eq!(first, BTreeSet::from([2 * 8 + 2, 2 * 8 + 6, 6 * 8 + 2, 6 * 8 + 6]));
    }

    #[test]
    fn every_count_gives_rectangles_that_cover_each_view_once() {
        for grid in [[1, 1], [1, 7], [3, 3], [4, 6], [5, 2], [8, 8]] {
            for num_views in [1, 3] {
                for num_tiles in num_views..=num_views * grid[0] * grid[1] {
                    let clusters = tile_clusters(num_views, grid, num_tiles).unwrap();
                    assert_eq!(clusters.centroid_index().len(), num_tiles);
                    let tiles = spans(&clusters, grid);
                    for ([rows, columns], tokens) in &tiles {
                        assert_eq!(rows * columns, tokens.len(), "a rectangle in one view: {grid:?}, {num_tiles}");
                        assert_eq!(tokens[0] / (grid[0] * grid[1]), tokens[tokens.len() - 1] / (grid[0] * grid[1]));
                    }
                    assert_eq!(
                        tiles.iter().map(|(_, tokens)| tokens.len()).sum::<usize>(),
                        clusters.assignment().len()
                    );
                }
            }
        }
    }

    #[test]
    fn the_tokens_in_the_middle_cover_a_view_in_both_directions() {
        for num_tiles in [4, 8, 16] {
            let clusters = tile_clusters(1, [16, 16], num_tiles).unwrap();
            let places =
                |place: fn(u32) -> u32| clusters.centroid_index().iter().map(|&t| place(t)).collect::<BTreeSet<_>>();
            let (rows, columns) = (places(|token| token / 16), places(|token| token % 16));
            let least = num_tiles.isqrt();
            assert!(rows.len() >= least && columns.len() >= least, "{num_tiles}: rows {rows:?}, columns {columns:?}");
        }
    }

    #[test]
    fn a_tile_for_every_token_is_the_identity_and_counts_out_of_range_are_named() {
        assert_eq!(tile_clusters(2, [3, 4], 24).unwrap().centroid_index().len(), 24);
        let message = |count| tile_clusters(2, [3, 4], count).unwrap_err().to_string();
        for count in [0, 1, 25] {
            assert!(message(count).contains("use 2 to 24"), "{}", message(count));
        }
    }
}
