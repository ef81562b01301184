//! Condensed tokens, K-means tokens or all tokens.

use strum::{Display, IntoStaticStr, VariantArray};

/// The kind of the tokens of a scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Display, IntoStaticStr, VariantArray)]
#[strum(serialize_all = "lowercase")]
pub enum TokenKind {
    /// Condensed tokens, rendered with the renderer of stage 2.
    Clift,
    /// The tokens nearest to the K-means centers, rendered with the renderer of stage 1.
    Kmeans,
    /// All tokens of a network without clusters, which has one stage; LVSM's learned latents.
    #[strum(serialize = "latents")]
    All,
}

impl TokenKind {
    /// Returns the name in files and tables.
    pub fn name(self) -> &'static str {
        self.into()
    }
}
