//! Writes scene files with plain tokens.

use std::fmt::Write as _;
use std::fs::File;
use std::io::{ErrorKind, Read as _};
use std::path::Path;

use clift_core::{folder_of, replace_file};
use clift_model::ModelError;

use crate::scene::header::write_fields;
use crate::scene::scene::{FORMAT, HEADER_BYTES, Scene, VERSION, dtype_name};
use crate::scene::token_format::TokenFormat;

/// Checks that a scene can be written to a path without loss: the folder exists, and the path is free or a scene file.
pub fn check_output_path(path: &Path) -> Result<(), ModelError> {
    let refuse = |reason: &str, fix| {
        Err(ModelError::SceneFile { action: "write", reason: reason.to_owned(), fix, path: path.into() })
    };
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

pub(crate) const WRITABLE_FOLDER: &str = "choose a folder that exists and can be written to";
const OTHER_NAME: &str = "choose another name";

impl Scene {
    /// Writes the scene to a temporary file in the folder of `path`, then renames the file: a file under its final name is
    /// complete.
    ///
    /// # Errors
    /// [`ModelError::SceneFile`] for an invalid scene and as [`check_output_path`], [`ModelError::BadConfig`] for tokens
    /// beyond the range of `format`.
    pub fn write(&self, path: &Path, format: TokenFormat) -> Result<(), ModelError> {
        let bytes = self.to_bytes(path, format)?;
        check_output_path(path)?;
        replace_file(path, &bytes).map_err(|error| ModelError::SceneFile {
            action: "write",
            reason: error.to_string(),
            fix: WRITABLE_FOLDER,
            path: path.into(),
        })
    }

    fn to_bytes(&self, path: &Path, format: TokenFormat) -> Result<Vec<u8>, ModelError> {
        let refuse = |reason| ModelError::SceneFile {
            action: "write",
            reason,
            fix: "encode other views or fewer tokens",
            path: path.into(),
        };
        self.check().map_err(refuse)?;
        let (tokens, scales) = format.encode(&self.tokens, self.model.dim)?;
        let (count, views) = (self.num_tokens(), self.context.len());
        let sizes: Vec<u32> = self.groups.iter().map(|group| group.views.len() as u32).collect();
        let members: Vec<u32> = self.groups.iter().flat_map(|group| group.views.clone()).collect();
        let frames = || self.groups.iter().map(|group| group.frame);
        let f64_bytes = |values: &mut dyn Iterator<Item = f64>| values.flat_map(f64::to_le_bytes).collect::<Vec<u8>>();
        let f32_bytes = |values: &[f32]| values.iter().flat_map(|value| value.to_le_bytes()).collect::<Vec<u8>>();
        let u32_bytes = |values: &[u32]| values.iter().flat_map(|value| value.to_le_bytes()).collect::<Vec<u8>>();
        let rays: Vec<f32> = self.plucker_rays().into_iter().flatten().map(|value| value as f32).collect();
        let mut tensors = vec![
            (
                "context_c2w",
                "F64",
                vec![views, 4, 4],
                f64_bytes(&mut self.context.iter().flat_map(|view| view.c2w.to_matrix_f64())),
            ),
            (
                "context_intrinsics",
                "F64",
                vec![views, 4],
                f64_bytes(&mut self.context.iter().flat_map(|view| view.intrinsics.to_array())),
            ),
            ("world_mean_c2w", "F64", vec![4, 4], f64_bytes(&mut self.world.mean_c2w.to_matrix_f64().into_iter())),
            ("world_scale", "F64", vec![1], f64_bytes(&mut [self.world.scale].into_iter())),
            (
                "group_mean_c2w",
                "F64",
                vec![sizes.len(), 4, 4],
                f64_bytes(&mut frames().flat_map(|frame| frame.mean_c2w.to_matrix_f64())),
            ),
            ("group_scale", "F64", vec![sizes.len()], f64_bytes(&mut frames().map(|frame| frame.scale))),
        ];
        let has_places = self.model.has_patch_tokens();
        if has_places {
            tensors.push(("token_rays", "F32", vec![count, 6], f32_bytes(&rays)));
        }
        if let Some(scales) = scales {
            tensors.push(("token_scales", "F32", vec![count], f32_bytes(&scales)));
        }
        tensors.push(("group_sizes", "U32", vec![sizes.len()], u32_bytes(&sizes)));
        tensors.push(("group_views", "U32", vec![members.len()], u32_bytes(&members)));
        tensors.push(("context_frames", "U32", vec![views], u32_bytes(&self.context_frames)));
        if has_places {
            tensors.push(("token_ids", "U32", vec![count], u32_bytes(&self.token_ids)));
        }
        tensors.push(("tokens", dtype_name(format), vec![count, self.model.dim], tokens));

        let mut header = self.metadata().map_err(refuse)?;
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
            return Err(ModelError::SceneFile {
                action: "write",
                reason: format!("the scene's key and model path together are longer than {most} bytes"),
                fix: "give the model by a shorter path",
                path: path.into(),
            });
        }
        let mut bytes = (HEADER_BYTES as u64).to_le_bytes().to_vec();
        bytes.extend(header.bytes());
        bytes.resize(8 + HEADER_BYTES, b' ');
        for (.., data) in &tensors {
            bytes.extend(data);
        }
        Ok(bytes)
    }

    fn metadata(&self) -> Result<String, String> {
        let model = serde_json::to_string(&self.model).map_err(|error| error.to_string())?;
        Ok(write_fields(&[
            ("format", FORMAT),
            ("version", VERSION),
            ("key", &self.key),
            ("kind", self.kind.name()),
            ("model", &model),
            ("renderer", &self.renderer_hash),
            ("model_path", &self.model_path),
            ("height", &self.height.to_string()),
            ("width", &self.width.to_string()),
        ]))
    }
}
