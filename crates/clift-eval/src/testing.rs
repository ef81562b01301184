//! Keys and views for unit tests.

use clift_core::{Camera, ClipViews, Intrinsics, Pose};
use clift_scene::TokenCoding;

use crate::config::method::Method;
use crate::statistics::view_metrics::EvalKey;

/// A key with half of the stored tokens rendered.
pub const CLIFT: EvalKey =
    EvalKey { method: Method::Clift, num_storage_tokens: 64, num_render_tokens: 32, tokens: Some(TokenCoding::F16) };

pub fn f32_key(method: Method, num_storage_tokens: usize, num_render_tokens: usize) -> EvalKey {
    EvalKey { method, num_storage_tokens, num_render_tokens, tokens: Some(TokenCoding::F32) }
}

pub fn gray_views((width, height): (usize, usize), level: u8, c2w: Vec<Pose>, frame_index: Vec<usize>) -> ClipViews {
    let intrinsics = Intrinsics { fx: 16.0, fy: 16.0, cx: 8.0, cy: 8.0 };
    ClipViews {
        width,
        height,
        images: vec![level; frame_index.len() * height * width * 3],
        cameras: c2w.into_iter().map(|c2w| Camera { c2w, intrinsics }).collect(),
        frame_index,
    }
}
