//! Writes scene files with plain tokens.

use std::fmt::Write as _;
use std::fs::File;
use std::io::{ErrorKind, Read as _};
use std::path::Path;

use clift_core::{folder_of, replace_file};
use clift_model::ModelError;

use crate::scene::header::write_fields;
use crate::scene::scene::{FORMAT, HEADER_BYTES, Scene, VERSION, dtype_name};
use crate::scene::token_coding::TokenFormat;
use crate::tensors::{f32_bytes, f64_bytes, u32_bytes};

/// Checks that a scene can be written to a path without loss: the folder exists, and the path is free or a scene file.
pub fn check_output_path(path: &Path) -> Result<(), ModelError> {
    let refuse = |reason: &str, fix| Err(refusal_to_write(path, reason.to_owned(), fix));
    let folder = folder_of(path);
    if !folder.is_dir() {
        return refuse(&format!("no folder {}", folder.display()), WRITABLE_FOLDER);
    }
    match std::fs::symlink_metadata(path) {
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(()),
        Err(error) => refuse(&error.to_string(), WRITABLE_FOLDER),
        Ok(found) if !found.is_file() => refuse("the existing item is not a regular file", OTHER_NAME),
        Ok(_) if is_scene(path) => Ok(()),
        Ok(_) => refuse("the existing file is not a scene, and only scenes are overwritten", OTHER_NAME),
    }
}

/// Whether the header of a file has the format of scenes; the version does not matter, and the file may be truncated.
fn is_scene(path: &Path) -> bool {
    let mut start = Vec::new();
    let read = File::open(path).and_then(|file| file.take(8 + HEADER_BYTES as u64).read_to_end(&mut start));
    let field = format!("\"format\":\"{FORMAT}\"");
    read.is_ok() && start.windows(field.len()).any(|part| part == field.as_bytes())
}

const WRITABLE_FOLDER: &str = "choose a folder that exists and can be written to";
const OTHER_NAME: &str = "choose another name";
pub(crate) const FEWER: &str = "encode other views or fewer tokens";

pub(crate) fn refusal_to_write(path: &Path, reason: String, fix: &'static str) -> ModelError {
    ModelError::SceneFile { action: "write", reason, fix, path: path.into() }
}

/// Writes the bytes of a scene to a temporary file in the folder of `path`, then renames the file: a file under its final name
/// is complete.
pub(crate) fn write_file(path: &Path, bytes: &[u8]) -> Result<(), ModelError> {
    check_output_path(path)?;
    replace_file(path, bytes).map_err(|error| refusal_to_write(path, error.to_string(), WRITABLE_FOLDER))
}

impl Scene {
    /// Writes the scene atomically, with tokens as plain numbers.
    pub fn write(&self, path: &Path, format: TokenFormat) -> Result<(), ModelError> {
        self.check().map_err(|reason| refusal_to_write(path, reason, FEWER))?;
        let tokens = format.encode(&self.tokens)?;
        let (count, views, groups) = (self.num_tokens(), self.context.len(), self.groups.len());
        let sizes = u32_bytes(self.groups.iter().map(|group| group.views.len() as u32));
        let members = u32_bytes(self.groups.iter().flat_map(|group| group.views.iter().copied()));
        let frames = || self.groups.iter().map(|group| group.frame);
        let poses = f64_bytes(self.context.iter().flat_map(|view| view.c2w.to_matrix_f64()));
        let intrinsics = f64_bytes(self.context.iter().flat_map(|view| view.intrinsics.to_array()));
        let means = f64_bytes(frames().flat_map(|frame| frame.mean_c2w.to_matrix_f64()));
        let mut tensors = vec![
            ("context_c2w", "F64", vec![views, 4, 4], poses),
            ("context_intrinsics", "F64", vec![views, 4], intrinsics),
            ("world_mean_c2w", "F64", vec![4, 4], f64_bytes(self.world.mean_c2w.to_matrix_f64())),
            ("world_scale", "F64", vec![1], f64_bytes([self.world.scale])),
            ("group_mean_c2w", "F64", vec![groups, 4, 4], means),
            ("group_scale", "F64", vec![groups], f64_bytes(frames().map(|frame| frame.scale))),
        ];
        let has_places = self.model.has_patch_tokens();
        if has_places {
            let rays = self.plucker_rays().into_iter().flatten().map(|value| value as f32);
            tensors.push(("token_rays", "F32", vec![count, 6], f32_bytes(rays)));
        }
        tensors.push(("group_sizes", "U32", vec![groups], sizes));
        tensors.push(("group_views", "U32", vec![members.len() / 4], members));
        tensors.push(("context_frames", "U32", vec![views], u32_bytes(self.context_frames.iter().copied())));
        if has_places {
            tensors.push(("token_ids", "U32", vec![count], u32_bytes(self.token_ids.iter().copied())));
        }
        tensors.push(("tokens", dtype_name(format), vec![count, self.model.dim], tokens));

        let model = serde_json::to_string(&self.model).expect("a config is JSON");
        let mut header = write_fields(&[
            ("format", FORMAT),
            ("version", VERSION),
            ("key", &self.key),
            ("kind", self.kind.name()),
            ("model", &model),
            ("renderer", &self.renderer_hash),
            ("model_path", &self.model_path),
            ("height", &self.height.to_string()),
            ("width", &self.width.to_string()),
        ]);
        let mut start = 0;
        for (name, dtype, shape, data) in &tensors {
            let end = start + data.len();
            let _ = write!(
                header,
                ",\"{name}\":{{\"dtype\":\"{dtype}\",\"shape\":{shape:?},\"data_offsets\":[{start},{end}]}}"
            );
            start = end;
        }
        header.push('}');
        if header.len() > HEADER_BYTES {
            let most = HEADER_BYTES - (header.len() - self.key.len() - self.model_path.len()).min(HEADER_BYTES);
            let reason = format!("the scene's key and model path together are longer than {most} bytes");
            return Err(refusal_to_write(path, reason, "give the model by a shorter path"));
        }
        let mut bytes = (HEADER_BYTES as u64).to_le_bytes().to_vec();
        bytes.extend(header.bytes());
        bytes.resize(8 + HEADER_BYTES, b' ');
        for (.., data) in &tensors {
            bytes.extend(data);
        }
        write_file(path, &bytes)
    }
}
