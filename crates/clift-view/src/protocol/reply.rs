//! Messages of the server: the length of a JSON header (u32, little-endian), the header, and the parts it lists.

use serde::Serialize;

/// The first message: what the server offers.
#[derive(Debug, Serialize)]
pub struct Hello {
    /// Keys of the scenes.
    pub scenes: Vec<String>,
    pub device: String,
    pub selections: Vec<&'static str>,
    pub default_selection: &'static str,
    pub precisions: Vec<&'static str>,
    pub default_precision: &'static str,
    pub version: &'static str,
}

/// A camera of the scene: rows of the camera-to-world matrix, and `fx, fy, cx, cy` over width and height.
#[derive(Debug, Serialize)]
pub struct SceneCamera {
    pub frame: usize,
    pub c2w: [f64; 12],
    pub intrinsics: [f64; 4],
}

/// An opened scene. The parts are the context images in their order.
#[derive(Debug, Serialize)]
pub struct OpenedScene<'a> {
    pub scene: usize,
    pub key: &'a str,
    /// Width and height of the context views in pixels.
    pub size: [usize; 2],
    /// Offered sizes, the first that of the context views.
    pub sizes: &'a [[usize; 2]],
    pub patch: usize,
    /// Stored tokens, and the offered numbers.
    pub stored: usize,
    pub storage_counts: &'a [usize],
    /// Number of tokens before clustering.
    pub num_patches: usize,
    pub bytes: u64,
    /// Kind and number format of the tokens.
    pub tokens: String,
    /// Most tokens of a group of context views, from which a frame is rendered.
    pub renderable: usize,
    /// Context view of each member of the groups.
    pub members: Vec<u32>,
    /// Patch of each token, counted over the members.
    pub token_ids: &'a [u32],
    /// Token of each patch; `null` for a scene file, which does not hold the clusters.
    pub clusters: Option<&'a [u32]>,
    pub context: Vec<SceneCamera>,
    /// Whether the parts are the true context images; a scene file holds no images, its contexts are rendered.
    pub has_true_images: bool,
    /// Frames with a true image that are not context views.
    pub frames: Vec<SceneCamera>,
    /// Distance of the point that the contexts look at, from the origin along +z.
    pub focus: f64,
    /// Normalization: mean context camera in the world of the capture, and normalized units per unit of that world.
    pub mean_c2w: [f64; 16],
    pub scale: f64,
    /// Command that writes the scene file, for a scene of a run; start of the command that renders the file.
    pub encode_command: Option<String>,
    pub render_command: String,
}

/// A rendered frame. The parts are one bit per stored token (absent unless requested) and the picture.
#[derive(Debug, Serialize)]
pub struct Frame {
    pub seq: u64,
    pub rest: bool,
    pub format: &'static str,
    pub size: [usize; 2],
    /// Rendered tokens.
    pub tokens: usize,
    pub stored: usize,
    pub select_ms: f64,
    pub render_ms: f64,
    pub encode_ms: f64,
}

/// A true frame and its rendering. The part is the true image as PNG, if requested.
#[derive(Debug, Serialize)]
pub struct Comparison {
    pub frame: usize,
    pub camera: SceneCamera,
    pub tokens: usize,
    /// PSNR of the rendering in dB.
    pub psnr: f64,
}

/// A header by its type.
#[derive(Debug, Serialize)]
#[serde(tag = "type", rename_all = "snake_case")]
pub enum Reply<'a> {
    Hello(Hello),
    Scene(Box<OpenedScene<'a>>),
    Frame(Frame),
    Comparison(Comparison),
    /// A request that failed.
    Failure {
        message: String,
    },
}

impl Reply<'_> {
    /// Returns the bytes of the message.
    pub fn to_bytes(&self, parts: &[&[u8]]) -> Vec<u8> {
        #[derive(Serialize)]
        struct Header<'a> {
            #[serde(flatten)]
            reply: &'a Reply<'a>,
            /// Bytes of each part.
            parts: Vec<usize>,
        }
        let header = Header { reply: self, parts: parts.iter().map(|part| part.len()).collect() };
        let header = serde_json::to_vec(&header).unwrap_or_default();
        let mut bytes = (header.len() as u32).to_le_bytes().to_vec();
        bytes.extend(header);
        bytes.extend(parts.iter().copied().flatten());
        bytes
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn message_is_header_and_parts() {
        let bytes = Reply::Failure { message: "no".into() }.to_bytes(&[b"ab", b"", b"c"]);
        let (length, rest) = bytes.split_first_chunk::<4>().unwrap();
        let (header, parts) = rest.split_at(u32::from_le_bytes(*length) as usize);
        let header: serde_json::Value = serde_json::from_slice(header).unwrap();
        assert_eq!(header, serde_json::json!({"type": "failure", "message": "no", "parts": [2, 0, 1]}));
        assert_eq!(parts, b"abc");
    }
}
