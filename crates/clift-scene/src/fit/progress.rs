//! Progress of fitting a codec.

/// Receiver of the progress of [`fit_codec`](crate::fit_codec), with the request to stop.
pub trait FitProgress {
    /// Reports that `scenes` of `total` are read. The first call has 0 scenes.
    fn done(&mut self, scenes: usize, total: usize);

    /// Reports a skipped scene.
    fn skipped(&mut self, key: &str, reason: &str);

    /// Returns whether to stop.
    fn is_interrupted(&self) -> bool;
}
