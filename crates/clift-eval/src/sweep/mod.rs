//! One scene with every method and count.
//!
//! - `eval_models`: trained models per method
//! - `sweep`: settings of a sweep
//! - `compressed_tokens`: tokens of a scene, their groups, stored tokens of a method
//! - `token_choice`: tokens selected for each view
//! - `context_check`: the context views, rendered themselves
//! - `view_scorer`: score renderings of a scene
//! - `rendered_views`: scored views of one `EvalKey`, results of one scene
//! - `evaluate_scene`: encode once, render every key

pub(crate) mod compressed_tokens;
pub(crate) mod context_check;
pub(crate) mod eval_models;
pub(crate) mod evaluate_scene;
pub(crate) mod rendered_views;
pub(crate) mod sweep;
pub(crate) mod token_choice;
pub(crate) mod view_scorer;
