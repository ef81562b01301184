//! Condensed or K-means tokens.

use strum::{Display, IntoStaticStr, VariantArray};

/// What the tokens of a scene are.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Display, IntoStaticStr, VariantArray)]
#[strum(serialize_all = "lowercase")]
pub enum TokenKind {
    /// Condensed tokens: drawn with the renderer of stage 2.
    Clift,
    /// The tokens nearest to the K-means centres: drawn with the renderer of stage 1.
    Kmeans,
}

impl TokenKind {
    /// Returns the name in files and tables.
    pub fn name(self) -> &'static str {
        self.into()
    }
}
