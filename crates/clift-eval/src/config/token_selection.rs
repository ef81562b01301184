//! Token selection settings.

use clift_model::SelectionPreset;
use serde::{Deserialize, Serialize};
use strum::{Display, IntoStaticStr, VariantArray};

/// Selection of the rendered tokens of a view, for fewer tokens than stored.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, Display, IntoStaticStr, VariantArray)]
#[serde(rename_all = "lowercase")]
#[strum(serialize_all = "lowercase")]
pub enum Selection {
    /// [`SelectionPreset::Paper`].
    Paper,
    /// [`SelectionPreset::Global`].
    Global,
    /// [`SelectionPreset::Scaled`].
    #[default]
    Scaled,
    /// Random tokens for every view: a baseline of the presets.
    Random,
}

impl Selection {
    /// Returns the preset of Algorithm 1; `None` for random tokens.
    pub fn preset(self) -> Option<SelectionPreset> {
        match self {
            Self::Paper => Some(SelectionPreset::Paper),
            Self::Global => Some(SelectionPreset::Global),
            Self::Scaled => Some(SelectionPreset::Scaled),
            Self::Random => None,
        }
    }
}
