//! Errors of encoding, checking and coding scenes.

/// An error of this crate.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
#[expect(missing_docs, reason = "the message of a variant says what its fields are")]
pub enum SceneError {
    /// A request that the scene or the model cannot meet.
    #[error("{reason}")]
    BadRequest { reason: String },
    /// A scene without context views has no baseline.
    #[error("baselines need at least one context view, got none")]
    NoContext,
    /// No scene is left to fit a codec on.
    #[error("no usable scene: {reason}")]
    NoScenes { reason: String },
    /// The caller stopped the fit of a codec.
    #[error(
        "interrupted while fitting the token codec, after {done} of {total} scenes; no codec was written: the same command fits it"
    )]
    Interrupted { done: usize, total: usize },
    /// Images could not be read.
    #[error(transparent)]
    Data(#[from] clift_data::DataError),
    /// The model refused its input, or a scene file or codec could not be read or written.
    #[error(transparent)]
    Model(#[from] clift_model::ModelError),
}

impl SceneError {
    pub(crate) fn request(reason: String) -> Self {
        Self::BadRequest { reason }
    }
}
