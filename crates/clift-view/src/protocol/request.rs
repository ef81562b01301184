//! Messages of the page: JSON text, checked before they reach the render thread.

use clift_core::{Camera, IntrinsicsNorm, MAX_COORDINATE, Pose};
use clift_model::{Precision, SelectionPreset};
use serde::de::{Deserialize, Deserializer, Error};

/// Largest accepted message in bytes. The page's largest has about 700.
pub const MAX_REQUEST_BYTES: usize = 4096;
/// Accepted focal lengths over width and height, and the largest distance of the principal point, as in pose files.
const FOCAL_RANGE: [f64; 2] = [1e-3, 1e3];

#[derive(Clone, Debug, PartialEq, serde::Deserialize)]
#[serde(tag = "type", rename_all = "snake_case", deny_unknown_fields)]
pub enum Request {
    Open(OpenRequest),
    View(ViewRequest),
    Compare(CompareRequest),
    /// Acknowledges a rendered frame.
    Ack {
        seq: u64,
    },
}

/// Position of a scene in the list, and its number of stored tokens.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OpenRequest {
    pub scene: usize,
    /// One of the offered counts; the nearest offered count otherwise. `None` for the default.
    pub stored: Option<usize>,
}

#[derive(Clone, Debug, PartialEq, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ViewRequest {
    pub seq: u64,
    /// First three rows of the camera-to-world matrix in the normalized frame, OpenCV axes.
    #[serde(deserialize_with = "pose_of_rows")]
    pub c2w: Pose,
    /// `fx, fy, cx, cy` over width and height.
    #[serde(deserialize_with = "intrinsics_of_numbers")]
    pub intrinsics: IntrinsicsNorm,
    /// Rendered tokens, at most all stored tokens are used.
    pub tokens: usize,
    pub selection: SelectionPreset,
    pub precision: Precision,
    /// Position in the list of sizes.
    pub size: usize,
    /// Milliseconds per frame while the camera moves; `None` without limit.
    pub budget_ms: Option<f64>,
    /// Whether the camera rests: a lossless picture with all settings as requested.
    pub rest: bool,
    /// Whether the reply lists the selected tokens.
    pub list_tokens: bool,
}

#[derive(Clone, Debug, PartialEq, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CompareRequest {
    /// Position in the list of true frames.
    pub frame: usize,
    pub tokens: usize,
    pub selection: SelectionPreset,
    pub precision: Precision,
    /// Whether the reply holds the true image.
    pub image: bool,
}

impl ViewRequest {
    /// Returns the camera for an image of `width` by `height` pixels.
    pub fn camera(&self, [width, height]: [usize; 2]) -> Camera {
        Camera { c2w: self.c2w, intrinsics: self.intrinsics.to_pixels(width, height) }
    }
}

fn pose_of_rows<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Pose, D::Error> {
    let values = <[f64; 12]>::deserialize(deserializer)?;
    let rows = [0, 1, 2].map(|row| [0, 1, 2, 3].map(|column| values[row * 4 + column]));
    let pose = Pose::from_rows(&rows).map_err(D::Error::custom)?;
    if pose.translation.abs().max_element() > MAX_COORDINATE {
        return Err(D::Error::custom(format!("the camera is more than {MAX_COORDINATE} units away")));
    }
    Ok(pose)
}

fn intrinsics_of_numbers<'de, D: Deserializer<'de>>(deserializer: D) -> Result<IntrinsicsNorm, D::Error> {
    let [fx, fy, cx, cy] = <[f64; 4]>::deserialize(deserializer)?;
    let [least, most] = FOCAL_RANGE;
    let is_valid = [fx, fy].iter().all(|f| (least..=most).contains(f)) && [cx, cy].iter().all(|c| c.abs() <= most);
    if is_valid { Ok(IntrinsicsNorm { fx, fy, cx, cy }) } else { Err(D::Error::custom("intrinsics out of range")) }
}

#[cfg(test)]
pub mod tests {
    use serde_json::{Value, json};

    use super::*;

    /// A valid request.
    pub fn view(seq: u64) -> Value {
        json!({
            "type": "view", "seq": seq, "c2w": [1, 0, 0, 0.5, 0, 1, 0, 0, 0, 0, 1, -2],
            "intrinsics": [1, 1.2, 0.5, 0.5], "tokens": 16, "selection": "scaled", "precision": "f32", "size": 1,
            "budget_ms": null, "rest": false, "list_tokens": true,
        })
    }

    #[test]
    fn invalid_requests_are_refused() {
        for (key, value) in [
            ("c2w", json!([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 2, 0])),
            ("c2w", json!([1, 0, 0, 1e4, 0, 1, 0, 0, 0, 0, 1, 0])),
            ("c2w", json!([1, 0, 0])),
            ("intrinsics", json!([0, 1, 0.5, 0.5])),
            ("intrinsics", json!([1, 1, 0.5, 1e9])),
            ("selection", json!("../../etc/passwd")),
            ("precision", json!("f8")),
            ("tokens", json!(-1)),
            ("size", json!(0.5)),
            ("path", json!("/etc/passwd")),
            ("type", json!("shell")),
        ] {
            let mut message = view(7);
            message[key] = value.clone();
            assert!(serde_json::from_value::<Request>(message).is_err(), "{key} = {value}");
        }
        assert!(serde_json::from_str::<Request>(&"[".repeat(MAX_REQUEST_BYTES)).is_err());
        assert!(serde_json::from_str::<Request>(&view(7).to_string().replace("-2", "1e999")).is_err());
    }
}
