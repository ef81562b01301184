//! Errors of encoding, checking and coding scenes.

/// An error of this crate.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
#[expect(missing_docs, reason = "the message of a variant says what its fields are")]
pub enum SceneError {
    #[error("{reason}")]
    BadRequest { reason: String },
    #[error("baselines need at least one context view, got none")]
    NoContext,
    #[error("no usable scene: {reason}")]
    NoScenes { reason: String },
    #[error(
        "interrupted while fitting the token codec, after {done} of {total} scenes; no codec was written: the same command fits it"
    )]
    Interrupted { done: usize, total: usize },
    #[error(transparent)]
    Data(#[from] clift_data::DataError),
    #[error(transparent)]
    Model(#[from] clift_model::ModelError),
}

impl SceneError {
    pub(crate) fn request(reason: String) -> Self {
        Self::BadRequest { reason }
    }
}
