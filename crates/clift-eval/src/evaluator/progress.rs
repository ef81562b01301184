//! Progress of an evaluation.

/// Receiver of progress, with the request to stop.
pub trait EvalProgress {
    /// Reports that `scenes` of `total` are done. The first call has 0 scenes.
    fn done(&mut self, scenes: usize, total: usize);

    /// Reports a line of text.
    fn note(&mut self, text: &str);

    /// Reports a skipped scene.
    fn skipped(&mut self, key: &str, reason: &str);

    /// Returns whether to stop the evaluation.
    fn is_interrupted(&self) -> bool;
}
