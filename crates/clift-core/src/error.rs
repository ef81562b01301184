//! Errors of cameras and their normalization.

/// A camera that cannot be used, or cameras without a normalized frame.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
#[expect(missing_docs, reason = "the message of a variant says what its fields are")]
pub enum CameraError {
    #[error("bad camera: {what}")]
    BadCamera { what: String },
    #[error(
        "scene {key} has no baseline: {}; the method needs parallax, photos from different places: a camera that only turns on \
         a tripod shows no depth",
        match num_views {
            1 => "it has one view, and at least two are needed".to_owned(),
            _ => format!(
                "its {num_views} camera centres lie within {extent:.3e} of their mean, below the resolution of f32 files, \
                 {threshold:.3e}"
            ),
        }
    )]
    ZeroBaseline { key: String, num_views: usize, extent: f64, threshold: f64 },
    #[error("frame {frame} of scene {key}: {source}")]
    InFrame { key: String, frame: usize, source: Box<CameraError> },
}
