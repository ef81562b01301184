//! The scene file with coded tokens: a safetensors file with one tensor, `scene`, of all bytes after the header.
//!
//! `docs/reference/files.md` lists its parts, and describes how tokens are decoded. What does not differ between the scenes of a
//! model is in the codec, see [`TokenCodec`].
// N patches of the context views, S tokens, V context views

use std::fmt::Write as _;
use std::path::Path;

use clift_model::{ModelConfig, ModelError};

use crate::codec::prediction::Places;
use crate::codec::token_codec::TokenCodec;
use crate::scene::coded_views::{read_groups, read_views, read_world, write_groups, write_views, write_world};
use crate::scene::header::{COPY_AGAIN, Fields, GIVE_MODEL, Refusal, refusal, write_fields};
use crate::scene::scene::{CODED_VERSION, FORMAT, Scene};
use crate::scene::token_coding::{CodedLoss, TokenCoding};
use crate::scene::write::{FEWER, refusal_to_write, write_file};
use crate::tensors::{numbers, u32_bytes};

impl Scene {
    /// Returns the bytes of the scene's coded file. Tokens are stored in the order of their ids.
    pub fn coded_bytes(&self, codec: &TokenCodec, step: f32) -> Result<Vec<u8>, ModelError> {
        let is_same_model = codec.model == ModelConfig { patch_grids: codec.model.patch_grids, ..self.model.clone() };
        if codec.renderer_hash != self.renderer_hash || codec.kind != self.kind || !is_same_model {
            let (value, fix) = (codec.hash.clone(), "the codec is of another model; fit it with `clift codec`".into());
            return Err(ModelError::BadConfig { key: "codec", value, fix });
        }
        let words = codec.encode(&self.tokens, self.places(), step)?;

        let mut body = step.to_le_bytes().to_vec();
        write_world(&self.world, &mut body);
        write_views(&self.context, &self.context_frames, &mut body);
        write_groups(&self.groups, &mut body);
        body.extend(u32_bytes(words));
        let length = body.len() + 4;

        let views = format!("{}x{}x{}", self.context.len(), self.height, self.width);
        let mut header = write_fields(&[
            ("format", FORMAT),
            ("version", CODED_VERSION),
            ("key", &self.key),
            ("codec", &codec.hash),
            ("model_path", &self.model_path),
            ("views", &views),
            ("tokens", &self.num_tokens().to_string()),
        ]);
        let _ = write!(header, ",\"scene\":{{\"dtype\":\"U8\",\"shape\":[{length}],\"data_offsets\":[0,{length}]}}}}");
        let mut bytes = (header.len() as u64).to_le_bytes().to_vec();
        bytes.extend(header.bytes());
        bytes.extend(body);
        let checksum = crc32fast::hash(&bytes);
        bytes.extend(checksum.to_le_bytes());
        Ok(bytes)
    }

    /// Returns the tokens as they come back from a coded file.
    pub fn rounded_tokens(&self, codec: &TokenCodec, step: f32) -> Result<Vec<f32>, ModelError> {
        codec.round(&self.tokens, self.places(), step)
    }

    /// Returns the patches of the tokens. Sides of views are multiples of the patch, which is checked elsewhere.
    fn places(&self) -> Places<'_> {
        let [rows, columns] = [self.height, self.width].map(|side| side / self.model.patch_size);
        Places { ids: &self.token_ids, grid: [self.num_members(), rows, columns] }
    }

    /// Writes the scene with coded tokens, as [`write`](Self::write) writes plain ones.
    pub fn write_coded(&self, path: &Path, codec: &TokenCodec, step: f32) -> Result<(), ModelError> {
        self.check().map_err(|reason| refusal_to_write(path, reason, FEWER))?;
        write_file(path, &self.coded_bytes(codec, step)?)
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
    let ([views, height, width], num_tokens) = (fields.views()?, fields.count("tokens")?);
    let split = || {
        let (step, rest) = body[..body.len().saturating_sub(4)].split_first_chunk::<4>()?;
        let (world, rest) = read_world(rest)?;
        let (views, rest) = read_views(views, rest)?;
        let (groups, words) = read_groups(rest)?;
        (words.len() % 4 == 0).then_some((f32::from_le_bytes(*step), world, views, groups, words))
    };
    let Some((step, world, (context, context_frames), groups, words)) = split() else {
        return Err(format!("{} bytes of {views} views and coded tokens", body.len()).into());
    };
    let words = numbers(words, u32::from_le_bytes);
    let mut scene = Scene {
        key: fields.get("key")?.into(),
        kind: codec.kind,
        model: codec.model.clone(),
        renderer_hash: codec.renderer_hash.clone(),
        model_path: fields.get("model_path")?.into(),
        height,
        width,
        context,
        context_frames,
        groups,
        world,
        token_ids: Vec::new(),
        tokens: Vec::new(),
    };
    let num_patches = scene.check_views()?;
    (scene.token_ids, scene.tokens) = codec.decode(words, num_tokens, scene.places().grid, step)?;
    scene.check()?;
    let loss = codec.rates.loss(num_tokens as f64 / num_patches as f64, f64::from(step));
    Ok((scene, TokenCoding::Coded(CodedLoss::from_db(loss))))
}

#[cfg(test)]
mod tests;
