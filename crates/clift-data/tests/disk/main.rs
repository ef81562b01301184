//! Scenes on disk: every layout, lens distortion, and what is broken or hostile.

mod captures;
mod files;
mod hostile;
mod layouts;
mod lenses;
