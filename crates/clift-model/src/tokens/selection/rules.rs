//! Published presets and their numbers.

use std::str::FromStr;

use strum::{Display, IntoStaticStr, VariantArray};

use crate::error::ModelError;
use crate::names::parse_value;
use crate::views::camera::ViewCamera;

/// Side of a cell of the target's grid, in pixels.
pub const CELL_PX: f64 = 16.0;

/// Cells along the shorter side where they scale with the picture: those of 256 pixels.
pub const SCALED_CELLS: f64 = 16.0;

/// Cells beyond each edge of the picture.
pub const MARGIN_CELLS: usize = 4;

/// A published set of rules.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Display, IntoStaticStr, VariantArray)]
#[strum(serialize_all = "lowercase")]
pub enum SelectionPreset {
    /// Algorithm 1 as printed: the nearest tokens of every cell, momentum, and a bonus for tokens of the previous
    /// frame.
    Paper,
    /// Tokens nearest to any cell, frame by frame: what the released code's table of render budgets uses.
    Global,
    /// As the paper's, with cells that scale with the picture: the same at 256 pixels. Around a picture of 32 pixels,
    /// four cells of 16 are four fifths of the grid's width, and most tokens go to what is not seen. A camera that turns
    /// by more than a cell from one frame to the next has been cut: that frame starts without momentum and bonus.
    #[default]
    Scaled,
}

impl SelectionPreset {
    /// All presets.
    pub const ALL: [Self; 3] = *Self::VARIANTS.as_array().expect("three variants");

    /// Returns the name as it is typed.
    pub fn name(self) -> &'static str {
        self.into()
    }

    /// The rules behind the name.
    pub fn rules(self) -> SelectionRules {
        match self {
            Self::Paper => SelectionRules::default(),
            Self::Global => {
                SelectionRules { previous_bonus: 0.0, momentum: 0.0, per_cell: false, ..SelectionRules::default() }
            }
            Self::Scaled => SelectionRules { scaled_cells: true, cuts: true, ..SelectionRules::default() },
        }
    }
}

impl FromStr for SelectionPreset {
    type Err = ModelError;

    fn from_str(name: &str) -> Result<Self, ModelError> {
        parse_value("selection", name)
    }
}

/// How near a token is to a cell, how many each cell is given, and how large it is. The default is the paper's.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SelectionRules {
    /// Weight of the angle between the rays of token and cell, in radians.
    pub angle_weight: f32,
    /// Weight of the distance between the cameras of token and target, in normalised units.
    pub distance_weight: f32,
    /// Taken off the distance of a token that the previous frame was drawn from.
    pub previous_bonus: f32,
    /// Share of the previous frame's distances in this frame's, in `[0, 1)`.
    pub momentum: f32,
    /// Whether every cell is given its `R / Q` nearest tokens before the rest is given to the nearest of all.
    pub per_cell: bool,
    /// Whether a cell is a sixteenth of the picture's shorter side instead of 16 pixels.
    pub scaled_cells: bool,
    /// Whether a frame whose camera has turned by more than a cell starts without momentum and bonus. Departs from the
    /// paper, whose frames are those of a video: smoothed over a jump, distances are those of no view.
    pub cuts: bool,
}

impl Default for SelectionRules {
    fn default() -> Self {
        Self {
            angle_weight: 1.0,
            distance_weight: 0.02,
            previous_bonus: 0.03,
            momentum: 0.5,
            per_cell: true,
            scaled_cells: false,
            cuts: false,
        }
    }
}

impl SelectionRules {
    /// Side of a cell of the target's grid, in pixels.
    fn cell_px(&self, height: usize, width: usize) -> f64 {
        if self.scaled_cells { height.min(width).max(1) as f64 / SCALED_CELLS } else { CELL_PX }
    }

    /// Rows and columns of the target's grid: cells that cover the picture, and a margin of four.
    pub fn grid(&self, height: usize, width: usize) -> [usize; 2] {
        let cell_px = self.cell_px(height, width);
        [height, width].map(|side| (side as f64 / cell_px).ceil() as usize + 2 * MARGIN_CELLS)
    }

    /// Directions through the centres of the cells of the target's grid, row by row; margin cells lie outside the
    /// picture.
    ///
    /// # Shapes
    /// - returns `[rows * columns]` unit directions with `[rows, columns]` of [`SelectionRules::grid`]
    pub fn cell_directions(&self, camera: &ViewCamera, height: usize, width: usize) -> Vec<[f64; 3]> {
        let [rows, columns] = self.grid(height, width);
        let cell_px = self.cell_px(height, width);
        let centre = |cell: usize| (cell as f64 - MARGIN_CELLS as f64 + 0.5) * cell_px;
        let cells = (0..rows).flat_map(|row| (0..columns).map(move |column| (row, column)));
        cells.map(|(row, column)| camera.direction(centre(column), centre(row))).collect()
    }
}
