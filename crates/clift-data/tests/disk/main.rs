//! Scenes on disk: every layout, lens distortion, and what is broken or hostile.

mod files;
mod hostile;
mod layouts;
mod lenses;
