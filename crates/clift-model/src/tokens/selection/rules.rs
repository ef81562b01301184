//! Weights and grid of the token selection, by preset.

use clift_core::{Camera, DVec3};
use serde::Deserialize;
use strum::{Display, IntoStaticStr, VariantArray};

/// The distance of a token to a cell is the angle between their rays, in radians, plus this weight times the distance of their
/// cameras, in normalized units.
pub(crate) const DISTANCE_WEIGHT: f32 = 0.02;
/// Subtracted from the distance of a token selected for the previous frame.
pub(crate) const PREVIOUS_BONUS: f32 = 0.03;
/// Weight of the distances of the previous frame.
pub(crate) const MOMENTUM: f32 = 0.5;
/// Side of a grid cell of the target view in pixels.
const CELL_PX: f64 = 16.0;
/// Cells along the shorter side of the image with scaled cells, as in an image of 256 pixels.
const SCALED_CELLS: f64 = 16.0;
/// Cells beyond each edge of the image.
const MARGIN_CELLS: usize = 4;

/// A named set of rules.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Display, IntoStaticStr, VariantArray)]
#[serde(rename_all = "lowercase")]
#[strum(serialize_all = "lowercase")]
pub enum SelectionPreset {
    /// Algorithm 1 of the paper: the nearest tokens of every cell, momentum, and a bonus for tokens of the previous frame.
    Paper,
    /// Tokens nearest to any cell, independent of the previous frame, as the released code selects for its table of render
    /// budgets.
    Global,
    /// Algorithm 1 with cells that scale with the image, at 256 pixels those of [`SelectionPreset::Paper`]: for an image of
    /// 32 pixels, margins of four 16-pixel cells are four fifths of the grid's width and most tokens would lie outside the
    /// view. A camera that turns by more than a cell between frames is a cut, which starts without momentum and bonus.
    #[default]
    Scaled,
}

impl SelectionPreset {
    /// All presets.
    pub const ALL: &[Self] = Self::VARIANTS;

    /// Returns the name in configs and on the command line.
    pub fn name(self) -> &'static str {
        self.into()
    }

    /// Returns the rules of the preset.
    pub fn rules(self) -> SelectionRules {
        SelectionRules { per_cell: self != Self::Global, scaled: self == Self::Scaled }
    }
}

/// Tokens per cell, and the size of cells.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SelectionRules {
    /// Whether each of Q cells first selects its `R / Q` nearest tokens, with momentum and the bonus of the previous frame; the
    /// places left, of R, go to the tokens nearest to any cell. Otherwise all places do.
    pub(crate) per_cell: bool,
    /// Whether the side of a cell is 1/16 of the shorter side of the image instead of 16 pixels, and a frame whose camera turned
    /// by more than a cell starts without momentum and bonus. The paper's frames are consecutive frames of a video: distances
    /// smoothed over a cut belong to no view.
    pub(crate) scaled: bool,
}

impl SelectionRules {
    fn cell_px(self, height: usize, width: usize) -> f64 {
        if self.scaled { height.min(width).max(1) as f64 / SCALED_CELLS } else { CELL_PX }
    }

    /// Returns rows and columns of the grid: cells that cover the image, and a margin of four cells.
    pub(crate) fn grid(self, height: usize, width: usize) -> [usize; 2] {
        let cell_px = self.cell_px(height, width);
        [height, width].map(|side| (side as f64 / cell_px).ceil() as usize + 2 * MARGIN_CELLS)
    }

    /// Returns the unit directions through the cell centers, `[rows * columns]`; margin cells lie outside the image.
    pub(crate) fn cell_directions(self, camera: &Camera, height: usize, width: usize) -> Vec<DVec3> {
        let [rows, columns] = self.grid(height, width);
        let cell_px = self.cell_px(height, width);
        let center = |cell: usize| (cell as f64 - MARGIN_CELLS as f64 + 0.5) * cell_px;
        let cells = (0..rows).flat_map(|row| (0..columns).map(move |column| (row, column)));
        cells.map(|(row, column)| camera.direction(center(column), center(row))).collect()
    }
}
