//! Names of the rows, the same on the command line, in the JSON and in the PyTorch comparison.

use clift_model::{names, parse_variant};
use serde::Serialize;
use strum::{Display, IntoStaticStr, VariantArray};

/// A row of the table.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Display, IntoStaticStr, Serialize, VariantArray)]
#[serde(into = "&'static str")]
#[strum(serialize_all = "snake_case")]
pub enum BenchCase {
    /// Encoder: context views of one scene to its tokens.
    Encode,
    /// Latent K-means of one scene's tokens.
    Kmeans,
    /// Condenser: clusters of one scene to condensed tokens.
    Condense,
    /// The attention of equation 2 without projections.
    ClusterAttention,
    /// Renderer: one view of one scene from all its tokens.
    Render,
    /// Renderer: eight views of one scene in one call, with shared tokens; seconds are per view.
    #[strum(serialize = "render_8_views")]
    Render8Views,
    /// An update of stage 1.
    Stage1Step,
    /// An update of stage 2.
    Stage2Step,
}

impl BenchCase {
    /// All cases, in the order they run.
    pub const ALL: &'static [Self] = Self::VARIANTS;

    /// Whether the case clusters or condenses tokens.
    pub const fn needs_clusters(self) -> bool {
        !matches!(self, Self::Encode | Self::Render | Self::Render8Views | Self::Stage1Step)
    }

    /// Whether the error is measured on a smaller problem than the time.
    pub const fn is_checked_reduced(self) -> bool {
        matches!(self, Self::Stage1Step | Self::Stage2Step)
    }
}

impl std::str::FromStr for BenchCase {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        parse_variant(name.trim()).ok_or_else(|| format!("unknown; the cases are {}", names::<Self>()))
    }
}
