//! Version 3 of the scene file: coded tokens.
//!
//! | part | type |
//! |---|---|
//! | length of the header, little-endian | u64 |
//! | header: JSON of safetensors with one tensor, `scene`, which is the rest of the file | |
//! | step of the coefficients | f32 |
//! | `world_mean_c2w`, first three rows, and `world_scale`: the normalization of poses | 13 x f64 |
//! | for each context view: first three rows of the pose, `fx, fy, cx, cy` in pixels, frame number | 16 x f32, u32 |
//! | words of the entropy coder: token ids, then levels by direction | u32 |
//! | CRC-32 of everything before | u32 |
//!
//! `__metadata__` holds strings: `format` = `clift-scene`, `version` = `3`, `key`, `codec` (hash of the model's codec),
//! `model_path`, `height` and `width`, `views` and `tokens` (counts). Everything else is in the codec, see
//! [`TokenCodec`]. `docs/reference/files.md` has a decoder.
// N patches of the context views, S tokens, V context views

use std::fmt::Write as _;
use std::path::Path;

use crate::codec::token_codec::TokenCodec;
use crate::error::ModelError;
use crate::files::replace;
use crate::network::config::ModelConfig;
use crate::scene::header::{COPY_AGAIN, Fields, GIVE_MODEL, Refusal, refusal, write_fields};
use crate::scene::scene::{CODED_VERSION, FORMAT, Scene, SceneNormalization};
use crate::scene::token_coding::{CodedLoss, TokenCoding};
use crate::scene::write::{WRITABLE_FOLDER, check_output_path};
use crate::views::camera::ViewCamera;

const WORLD_VALUES: usize = 13;
const VIEW_BYTES: usize = 17 * 4;
/// Bytes of step, normalization and checksum.
const FIXED_BYTES: usize = 4 + WORLD_VALUES * 8 + 4;

impl Scene {
    /// Returns the bytes of the scene's coded file. Tokens are stored in the order of their ids.
    ///
    /// # Errors
    /// [`ModelError::BadConfig`] for a codec of another model, or a step that is not positive or too small.
    pub fn coded_bytes(&self, codec: &TokenCodec, step: f32) -> Result<Vec<u8>, ModelError> {
        let is_same_model = codec.model == ModelConfig { patch_grids: codec.model.patch_grids, ..self.model.clone() };
        if codec.renderer_hash != self.renderer_hash || codec.kind != self.kind || !is_same_model {
            let (value, fix) = (codec.hash.clone(), "the codec is of another model; fit it with `clift codec`".into());
            return Err(ModelError::BadConfig { key: "codec", value, fix });
        }
        let dim = self.model.dim;
        let mut order: Vec<usize> = (0..self.num_tokens()).collect();
        order.sort_by_key(|&token| self.token_ids[token]);
        let ids: Vec<u32> = order.iter().map(|&token| self.token_ids[token]).collect();
        let tokens: Vec<f32> =
            order.iter().flat_map(|&token| &self.tokens[token * dim..(token + 1) * dim]).copied().collect();
        let num_patches = self.model.num_patches(self.context.len(), self.height, self.width)?;
        let words = codec.encode(&tokens, &ids, num_patches, step)?;

        let mut body = step.to_le_bytes().to_vec();
        let world = self.world.mean_c2w[..12].iter().chain([&self.world.scale]);
        body.extend(world.flat_map(|value| value.to_le_bytes()));
        for (camera, frame) in self.context.iter().zip(&self.context_frames) {
            let values = camera.c2w[..12].iter().chain(&camera.intrinsics);
            body.extend(values.flat_map(|&value| (value as f32).to_le_bytes()));
            body.extend(frame.to_le_bytes());
        }
        body.extend(words.iter().flat_map(|word| word.to_le_bytes()));
        let length = body.len() + 4;

        let counts = [self.height, self.width, self.context.len(), self.num_tokens()].map(|count| count.to_string());
        let mut header = write_fields(&[
            ("format", FORMAT),
            ("version", CODED_VERSION),
            ("key", &self.key),
            ("codec", &codec.hash),
            ("model_path", &self.model_path),
            ("height", &counts[0]),
            ("width", &counts[1]),
            ("views", &counts[2]),
            ("tokens", &counts[3]),
        ]);
        let _ = write!(header, ",\"scene\":{{\"dtype\":\"U8\",\"shape\":[{length}],\"data_offsets\":[0,{length}]}}}}");
        let mut bytes = (header.len() as u64).to_le_bytes().to_vec();
        bytes.extend(header.bytes());
        bytes.extend(body);
        let checksum = crc32fast::hash(&bytes);
        bytes.extend(checksum.to_le_bytes());
        Ok(bytes)
    }

    /// Writes the scene with coded tokens, as [`write`](Self::write) writes plain ones.
    ///
    /// # Errors
    /// As [`coded_bytes`](Self::coded_bytes) and [`write`](Self::write).
    pub fn write_coded(&self, path: &Path, codec: &TokenCodec, step: f32) -> Result<(), ModelError> {
        let refuse = |reason, fix| ModelError::SceneFile { action: "write", reason, fix, path: path.into() };
        self.check().map_err(|reason| refuse(reason, "encode other views or fewer tokens"))?;
        let bytes = self.coded_bytes(codec, step)?;
        check_output_path(path)?;
        replace(path, &bytes).map_err(|error| refuse(error.to_string(), WRITABLE_FOLDER))
    }
}

/// Reads a coded scene of a file whose safetensors header is valid. `find_codec` returns the codec of a model path.
pub(crate) fn from_coded_bytes(
    bytes: &[u8],
    body: &[u8],
    fields: &Fields,
    find_codec: &dyn Fn(&str) -> Result<TokenCodec, String>,
) -> Result<(Scene, TokenCoding), Refusal> {
    let (checked, checksum) = bytes.split_last_chunk::<4>().ok_or_else(|| refusal("no checksum", COPY_AGAIN))?;
    let (found, stored) = (crc32fast::hash(checked), u32::from_le_bytes(*checksum));
    if found != stored {
        return Err(refusal(format!("the file is damaged: checksum {found:08x}, expected {stored:08x}"), COPY_AGAIN));
    }
    let codec = find_codec(fields.get("model_path")?).map_err(|reason| refusal(reason, GIVE_MODEL))?;
    let hash = fields.get("codec")?;
    if hash != codec.hash {
        let reason = format!("the scene was coded with the codec {hash}, the model has {}", codec.hash);
        return Err(refusal(reason, GIVE_MODEL));
    }
    let [views, num_tokens] = [fields.count("views")?, fields.count("tokens")?];
    let fixed = views.checked_mul(VIEW_BYTES).and_then(|bytes| bytes.checked_add(FIXED_BYTES));
    let Some(word_bytes) = fixed.and_then(|fixed| body.len().checked_sub(fixed)).filter(|rest| rest % 4 == 0) else {
        return Err(format!("{} bytes of {views} views and coded tokens", body.len()).into());
    };
    let (step, rest) = body.split_at(4);
    let (world, rest) = rest.split_at(WORLD_VALUES * 8);
    let (cameras, rest) = rest.split_at(views * VIEW_BYTES);
    let step = f32::from_le_bytes(step.try_into().expect("4 bytes"));
    let world: Vec<f64> = world.as_chunks::<8>().0.iter().map(|bytes| f64::from_le_bytes(*bytes)).collect();
    let words = rest[..word_bytes].as_chunks::<4>().0.iter().map(|bytes| u32::from_le_bytes(*bytes)).collect();
    let mut scene = Scene {
        key: fields.get("key")?.into(),
        kind: codec.kind,
        model: codec.model.clone(),
        renderer_hash: codec.renderer_hash.clone(),
        model_path: fields.get("model_path")?.into(),
        height: fields.count("height")?,
        width: fields.count("width")?,
        context: Vec::with_capacity(views),
        context_frames: Vec::with_capacity(views),
        world: SceneNormalization { mean_c2w: pose(world[..12].iter().copied()), scale: world[12] },
        token_ids: Vec::new(),
        tokens: Vec::new(),
    };
    for view in cameras.chunks_exact(VIEW_BYTES) {
        let values: Vec<f64> =
            view.as_chunks::<4>().0[..16].iter().map(|bytes| f64::from(f32::from_le_bytes(*bytes))).collect();
        let intrinsics = [values[12], values[13], values[14], values[15]];
        scene.context.push(ViewCamera { c2w: pose(values[..12].iter().copied()), intrinsics });
        scene.context_frames.push(u32::from_le_bytes(view.as_chunks::<4>().0[16]));
    }
    let num_patches = scene.check_views()?;
    (scene.token_ids, scene.tokens) = codec.decode(words, num_tokens, num_patches, step)?;
    scene.check()?;
    let loss = codec.rates.loss(num_tokens as f64 / num_patches as f64, f64::from(step));
    Ok((scene, TokenCoding::Coded(CodedLoss::from_db(loss))))
}

/// Returns the pose of three rows.
fn pose(rows: impl Iterator<Item = f64>) -> [f64; 16] {
    let mut pose = [0.0; 16];
    pose.iter_mut().zip(rows).for_each(|(entry, value)| *entry = value);
    pose[15] = 1.0;
    pose
}

#[cfg(test)]
mod tests;
