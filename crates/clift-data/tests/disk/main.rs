//! Scenes on disk: every layout, lens distortion, and what is broken or hostile.

mod captures;
mod files;
mod found;
mod hostile;
mod layouts;
mod left_out;
mod lenses;
