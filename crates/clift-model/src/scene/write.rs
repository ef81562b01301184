//! Scenes to files.

use std::fmt::Write as _;
use std::fs::File;
use std::io::{ErrorKind, Read as _};
use std::path::Path;

use crate::error::ModelError;
use crate::files::{folder_of, replace};
use crate::scene::scene::{FORMAT, HEADER_BYTES, Scene, VERSION, dtype_name};
use crate::scene::token_format::TokenFormat;

/// Where nothing is lost by writing a scene: a folder that exists, and in it nothing of the name or a scene.
///
/// # Errors
/// [`ModelError::SceneFile`].
pub fn check_output_path(path: &Path) -> Result<(), ModelError> {
    let refuse = |reason: &str, fix| {
        Err(ModelError::SceneFile { action: "write", reason: reason.to_owned(), fix, path: path.into() })
    };
    let folder = folder_of(path);
    if !folder.is_dir() {
        return refuse(&format!("there is no folder {}", folder.display()), WRITABLE_FOLDER);
    }
    match std::fs::symlink_metadata(path) {
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(()),
        Err(error) => refuse(&error.to_string(), WRITABLE_FOLDER),
        Ok(found) if !found.is_file() => refuse("what has the name is no regular file", OTHER_NAME),
        Ok(_) if is_scene(path) => Ok(()),
        Ok(_) => refuse("the file there is no scene, and only scenes are written over", OTHER_NAME),
    }
}

/// Whether a file says in its header that it is a scene, of any version, whole or not.
fn is_scene(path: &Path) -> bool {
    let mut start = Vec::new();
    let read = File::open(path).and_then(|file| file.take(8 + HEADER_BYTES as u64).read_to_end(&mut start));
    let says = format!("\"format\":\"{FORMAT}\"");
    read.is_ok() && start.windows(says.len()).any(|part| part == says.as_bytes())
}

const WRITABLE_FOLDER: &str = "choose a folder that exists and can be written to";
const OTHER_NAME: &str = "choose another name";

impl Scene {
    /// Writes the scene to a temporary name beside `path` that is then renamed: no reader sees half a file.
    ///
    /// # Errors
    /// [`ModelError::SceneFile`], for what [`check_output_path`] refuses too, and [`ModelError::BadConfig`] for tokens that
    /// `storage` cannot hold.
    pub fn write(&self, path: &Path, storage: TokenFormat) -> Result<(), ModelError> {
        let bytes = self.to_bytes(path, storage)?;
        check_output_path(path)?;
        replace(path, &bytes).map_err(|error| ModelError::SceneFile {
            action: "write",
            reason: error.to_string(),
            fix: WRITABLE_FOLDER,
            path: path.into(),
        })
    }

    fn to_bytes(&self, path: &Path, storage: TokenFormat) -> Result<Vec<u8>, ModelError> {
        let refuse = |reason| ModelError::SceneFile {
            action: "write",
            reason,
            fix: "encode other views or fewer tokens",
            path: path.into(),
        };
        self.check().map_err(refuse)?;
        let (tokens, scales) = storage.encode(&self.tokens, self.model.dim)?;
        let (count, views) = (self.num_tokens(), self.context.len());
        let f64_bytes = |values: &mut dyn Iterator<Item = f64>| values.flat_map(f64::to_le_bytes).collect::<Vec<u8>>();
        let f32_bytes = |values: &[f32]| values.iter().flat_map(|value| value.to_le_bytes()).collect::<Vec<u8>>();
        let u32_bytes = |values: &[u32]| values.iter().flat_map(|value| value.to_le_bytes()).collect::<Vec<u8>>();
        let rays: Vec<f32> = self.plucker_rays().into_iter().flatten().map(|value| value as f32).collect();
        let mut tensors = vec![
            ("context_c2w", "F64", vec![views, 4, 4], f64_bytes(&mut self.context.iter().flat_map(|view| view.c2w))),
            (
                "context_intrinsics",
                "F64",
                vec![views, 4],
                f64_bytes(&mut self.context.iter().flat_map(|view| view.intrinsics)),
            ),
            ("world_mean_c2w", "F64", vec![4, 4], f64_bytes(&mut self.world.mean_c2w.into_iter())),
            ("world_scale", "F64", vec![1], f64_bytes(&mut [self.world.scale].into_iter())),
            ("token_rays", "F32", vec![count, 6], f32_bytes(&rays)),
        ];
        if let Some(scales) = scales {
            tensors.push(("token_scales", "F32", vec![count], f32_bytes(&scales)));
        }
        tensors.push(("context_frames", "U32", vec![views], u32_bytes(&self.context_frames)));
        tensors.push(("token_ids", "U32", vec![count], u32_bytes(&self.token_ids)));
        tensors.push(("tokens", dtype_name(storage), vec![count, self.model.dim], tokens));

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
                reason: format!("the path of its model and its key are together longer than {most} bytes"),
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

    /// The header up to the first tensor. Written by hand: safetensors orders metadata at random, and equal scenes
    /// are equal files.
    fn metadata(&self) -> Result<String, String> {
        let json = |text: &str| serde_json::to_string(text).map_err(|error| error.to_string());
        let model = serde_json::to_string(&self.model).map_err(|error| error.to_string())?;
        let fields = [
            ("format", FORMAT),
            ("version", VERSION),
            ("key", &self.key),
            ("kind", self.kind.name()),
            ("model", &model),
            ("renderer", &self.renderer_hash),
            ("model_path", &self.model_path),
            ("height", &self.height.to_string()),
            ("width", &self.width.to_string()),
        ];
        let mut header = String::from("{\"__metadata__\":{");
        for (i, (name, value)) in fields.into_iter().enumerate() {
            let comma = if i == 0 { "" } else { "," };
            let _ = write!(header, "{comma}\"{name}\":{}", json(value)?);
        }
        header.push('}');
        Ok(header)
    }
}
