//! Progress of an evaluation, as the caller shows it.

/// Receives the progress of an evaluation, and stops the evaluation.
pub trait Progress {
    /// `scenes` of `total` are done; first called with none.
    fn done(&mut self, scenes: usize, total: usize);

    /// Something worth a line.
    fn note(&mut self, text: &str);

    /// A scene was skipped.
    fn skipped(&mut self, key: &str, reason: &str);

    /// Whether the evaluation shall stop.
    fn is_interrupted(&self) -> bool;
}
