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
///
/// # Errors
/// [`ModelError::BadClusters`] for fewer tiles than views, or more tiles than tokens.
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

    /// Returns the rows and columns that every cluster spans in its view, and its tokens.
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
    fn sixteen_tiles_of_four_views_are_squares() {
        let clusters = tile_clusters(4, [8, 8], 16).unwrap();
        assert!(spans(&clusters, [8, 8]).iter().all(|(span, tokens)| *span == [4, 4] && tokens.len() == 16));
        // Of the first view: tokens (2, 2), (2, 6), (6, 2), (6, 6), in some order.
        let first: BTreeSet<u32> = clusters.centroid_index()[..4].iter().copied().collect();
        assert_eq!(first, BTreeSet::from([2 * 8 + 2, 2 * 8 + 6, 6 * 8 + 2, 6 * 8 + 6]));
    }

    #[test]
    fn every_count_gives_disjoint_rectangles() {
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
    fn counts_out_of_range_are_refused() {
        let message = |count| tile_clusters(2, [3, 4], count).unwrap_err().to_string();
        for count in [0, 1, 25] {
            assert!(message(count).contains("use 2 to 24"), "{}", message(count));
        }
    }
}
