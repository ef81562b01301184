//! The architectures, and the variants of the network and of its attention, by name.

use serde::{Deserialize, Serialize};
use strum::{Display, IntoStaticStr, VariantArray};

use crate::names::{names, parse_variant};

/// Kind of the network.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize, Display, VariantArray,
)]
#[serde(rename_all = "kebab-case")]
#[strum(serialize_all = "kebab-case")]
pub enum Architecture {
    /// Light-field tokens of patches, condensed by clusters, read by cross-attention.
    #[default]
    Clift,
    /// The encoder-decoder of LVSM (arXiv 2410.17242): learned latents, encoded beside the patches by self-attention, and
    /// decoded beside the target patches by self-attention.
    LvsmEd,
}

impl Architecture {
    /// All architectures, in the order of messages and help texts.
    pub const ALL: &[Self] = Self::VARIANTS;

    /// Whether tokens can be clustered and condensed. Other networks are trained in stage 1 alone, and a scene of theirs is stored
    /// with all its tokens.
    pub fn supports_clusters(self) -> bool {
        self == Self::Clift
    }

    /// Returns the name among the methods of an evaluation.
    pub const fn method_name(self) -> &'static str {
        match self {
            Self::Clift => "clift",
            Self::LvsmEd => "lvsm_ed",
        }
    }
}

/// Variant of the network: as in its paper, or as in the released code. LVSM has that of its paper.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, Display, IntoStaticStr, VariantArray)]
#[serde(rename_all = "kebab-case")]
#[strum(serialize_all = "kebab-case")]
pub enum CliftVariant {
    /// The paper's equations: pre-norm blocks, two condenser blocks (paper section 3).
    #[default]
    Paper,
    /// The released code's network for `RealEstate10K`. Its condenser is one pre-norm decoder layer with `ReLU`, whose keys
    /// and values are all tokens of the cluster without a norm, followed by a gate with bias.
    ReleasedRe10k,
    /// The released code's network for DL3DV: [`CliftVariant::ReleasedRe10k`] with an RMS norm of every head's queries and
    /// keys in encoder and renderer, and a layer norm after the encoder.
    ReleasedDl3dv,
}

impl CliftVariant {
    /// All variants, in the order of messages and help texts.
    pub const ALL: [Self; 3] = *Self::VARIANTS.as_array().expect("three variants");

    /// Whether the network is one of the released code's.
    pub fn is_released(self) -> bool {
        self != Self::Paper
    }

    /// Whether the heads of queries and keys in encoder and renderer, and the encoder's tokens, have norms.
    pub fn has_norms(self) -> bool {
        self == Self::ReleasedDl3dv
    }
}

/// Camera information in attention. The rays of all pixels are inputs of the networks in every case.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, Display, IntoStaticStr, VariantArray)]
#[serde(rename_all = "lowercase")]
#[strum(serialize_all = "lowercase")]
pub enum CameraEncoding {
    /// Plücker coordinates of the pixels' rays, in the input alone (paper section 3.1).
    #[default]
    Plucker,
    /// Camera-relative attention by the poses of the cameras.
    Gta,
}

impl CameraEncoding {
    /// All encodings, in the order of messages and help texts.
    pub const ALL: [Self; 2] = *Self::VARIANTS.as_array().expect("two variants");
}

impl std::str::FromStr for CliftVariant {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        parse_variant(text).ok_or_else(|| format!("write {}", names::<Self>()))
    }
}
