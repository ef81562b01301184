//! The network that a config names.

use serde::{Deserialize, Serialize};
use strum::{Display, IntoStaticStr, VariantArray};

use crate::names::{names, parse};

/// Which published network the blocks follow.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, Display, IntoStaticStr, VariantArray)]
#[serde(rename_all = "kebab-case")]
#[strum(serialize_all = "kebab-case")]
pub enum CliftVariant {
    /// The paper's equations: pre-norm blocks, two condenser blocks (paper section 3).
    #[default]
    Paper,
    /// The released code's network for `RealEstate10K`: one condenser block, a pre-norm decoder layer with `ReLU` whose
    /// keys and values are the raw tokens of the cluster with its centroid, and one gate with a bias behind it.
    ReleasedRe10k,
    /// The released code's network for DL3DV: as [`CliftVariant::ReleasedRe10k`], with an RMS norm of every head's queries
    /// and keys in all attention, and a layer norm behind the encoder.
    ReleasedDl3dv,
}

impl CliftVariant {
    /// All variants, in the order they are listed to a user.
    pub const ALL: [Self; 3] = *Self::VARIANTS.as_array().expect("three variants");

    /// Returns the name as it is typed.
    pub fn as_str(self) -> &'static str {
        self.into()
    }

    /// Whether the condenser is the released code's.
    pub fn is_released(self) -> bool {
        self != Self::Paper
    }

    /// Whether queries and keys are normalised head by head, and tokens behind the encoder.
    pub fn has_norms(self) -> bool {
        self == Self::ReleasedDl3dv
    }
}

impl std::str::FromStr for CliftVariant {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        parse(text).ok_or_else(|| format!("write {}", names::<Self>()))
    }
}
