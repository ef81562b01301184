//! Files to scenes. A file is refused with the reason and what to do, before anything is made of it.

use std::collections::HashMap;
use std::path::Path;

use safetensors::{Dtype, SafeTensorError, SafeTensors};

use crate::error::ModelError;
use crate::names::parse;
use crate::network::config::ModelConfig;
use crate::scene::scene::{FORMAT, Scene, SceneNormalization, VERSION, dtype_name};
use crate::scene::token_format::TokenFormat;
use crate::views::camera::ViewCamera;

/// Longest header that is read; those of this version are shorter.
const MAX_HEADER_BYTES: u64 = 1 << 16;

/// Largest file that is read: 65,536 tokens of width 768 in f32 take a fifth of it.
const MAX_FILE_BYTES: u64 = 1 << 30;

/// Largest difference between a stored ray and that of its camera: f32 rays of cameras a few units from the origin.
const RAY_TOLERANCE: f64 = 1e-4;

const GIVE_ANOTHER: &str = "give a file that `clift encode` wrote";
const COPY_AGAIN: &str = "copy it again, or encode the scene again";
const OTHER_VERSION: &str = "use the version of clift that wrote it, or encode the scene again";

/// Why a file is refused, and what helps.
struct Refusal {
    reason: String,
    fix: &'static str,
}

impl From<String> for Refusal {
    fn from(reason: String) -> Self {
        Self { reason, fix: "encode the scene again" }
    }
}

fn refusal(reason: impl Into<String>, fix: &'static str) -> Refusal {
    Refusal { reason: reason.into(), fix }
}

impl Scene {
    /// Reads a scene file and checks all of it.
    ///
    /// # Errors
    /// [`ModelError::SceneFile`] for a file that is no scene, of another version, cut off, or inconsistent.
    pub fn read(path: &Path) -> Result<(Self, TokenFormat), ModelError> {
        let read = || {
            let size = std::fs::metadata(path).map_err(|error| refusal(error.to_string(), GIVE_ANOTHER))?.len();
            if size > MAX_FILE_BYTES {
                let reason = format!("it has {size} bytes, more than the {MAX_FILE_BYTES} a scene may have");
                return Err(refusal(reason, GIVE_ANOTHER));
            }
            from_bytes(&std::fs::read(path).map_err(|error| refusal(error.to_string(), GIVE_ANOTHER))?)
        };
        read().map_err(|Refusal { reason, fix }| ModelError::SceneFile {
            action: "use",
            reason,
            fix,
            path: path.into(),
        })
    }
}

fn from_bytes(bytes: &[u8]) -> Result<(Scene, TokenFormat), Refusal> {
    check_length(bytes)?;
    let file = SafeTensors::deserialize(bytes).map_err(|error| match error {
        SafeTensorError::MetadataIncompleteBuffer => {
            refusal("it is cut off, or goes on after its last tensor", COPY_AGAIN)
        }
        other => refusal(format!("its header cannot be read ({other})"), GIVE_ANOTHER),
    })?;
    let (_, metadata) = SafeTensors::read_metadata(bytes).map_err(|error| refusal(error.to_string(), GIVE_ANOTHER))?;
    let fields = Fields(metadata.metadata().clone().unwrap_or_default());
    if fields.0.get("format").map(String::as_str) != Some(FORMAT) {
        return Err(refusal("its header does not say that it is a scene", GIVE_ANOTHER));
    }
    let version = fields.get("version")?;
    if version != VERSION {
        return Err(refusal(format!("it has version {version:?}, this program reads {VERSION}"), OTHER_VERSION));
    }
    let kind = fields.get("kind")?;
    let kind = parse(kind).ok_or_else(|| format!("its tokens are of an unknown kind, {:?}", fields.0.get("kind")))?;
    let model: ModelConfig =
        serde_json::from_str(fields.get("model")?).map_err(|error| format!("its model cannot be read ({error})"))?;

    let tensors = Tensors(file);
    let (storage, num_tokens, tokens) = tensors.tokens(model.dim)?;
    let views = tensors.length("context_frames")?;
    let poses = tensors.f64s("context_c2w", &[views, 4, 4])?;
    let intrinsics = tensors.f64s("context_intrinsics", &[views, 4])?;
    let cameras = poses.as_chunks::<16>().0.iter().zip(intrinsics.as_chunks::<4>().0);
    let mut mean_c2w = [0.0; 16];
    mean_c2w.copy_from_slice(&tensors.f64s("world_mean_c2w", &[4, 4])?);
    let scene = Scene {
        key: fields.get("key")?.into(),
        kind,
        renderer_hash: fields.get("renderer")?.into(),
        model_path: fields.get("model_path")?.into(),
        height: fields.side("height")?,
        width: fields.side("width")?,
        context: cameras.map(|(&c2w, &intrinsics)| ViewCamera { c2w, intrinsics }).collect(),
        context_frames: tensors.u32s("context_frames", &[views])?,
        world: SceneNormalization { mean_c2w, scale: tensors.f64s("world_scale", &[1])?[0] },
        token_ids: tensors.u32s("token_ids", &[num_tokens])?,
        tokens,
        model,
    };
    scene.check()?;
    check_rays(&scene, &tensors.f32s("token_rays", &[num_tokens, 6])?)?;
    Ok((scene, storage))
}

/// The header's length, before anything is parsed or allocated for it.
fn check_length(bytes: &[u8]) -> Result<(), Refusal> {
    let Some((length, rest)) = bytes.split_first_chunk::<8>() else {
        return Err(refusal(format!("it is cut off: it has {} bytes", bytes.len()), COPY_AGAIN));
    };
    let length = u64::from_le_bytes(*length);
    if length > MAX_HEADER_BYTES {
        let reason = format!("its header would have {length} bytes, more than {MAX_HEADER_BYTES}");
        return Err(refusal(reason, GIVE_ANOTHER));
    }
    if length > rest.len() as u64 {
        let reason = format!("it is cut off: its header has {length} bytes, the file {}", bytes.len());
        return Err(refusal(reason, COPY_AGAIN));
    }
    Ok(())
}

/// The stored rays are for other programs; here they must be those of the cameras.
fn check_rays(scene: &Scene, rays: &[f32]) -> Result<(), String> {
    for (token, (stored, expected)) in rays.as_chunks::<6>().0.iter().zip(scene.plucker_rays()).enumerate() {
        let scale = expected.iter().fold(1.0, |most: f64, value| most.max(value.abs()));
        let is_close = |(a, b): (&f32, &f64)| (f64::from(*a) - b).abs() <= RAY_TOLERANCE * scale;
        if !stored.iter().zip(&expected).all(is_close) {
            return Err(format!("the ray of token {token} is {stored:?}, its camera's is {expected:?}"));
        }
    }
    Ok(())
}

/// The strings of a header.
struct Fields(HashMap<String, String>);

impl Fields {
    fn get(&self, name: &str) -> Result<&str, String> {
        self.0.get(name).map(String::as_str).ok_or_else(|| format!("its header has no `{name}`"))
    }

    fn side(&self, name: &str) -> Result<usize, String> {
        let value = self.get(name)?;
        value.parse().map_err(|_| format!("its {name} is {value:?}, not a number of pixels"))
    }
}

/// The tensors of a file, by name, type and shape.
struct Tensors<'a>(SafeTensors<'a>);

impl Tensors<'_> {
    fn view(&self, name: &str) -> Result<safetensors::tensor::TensorView<'_>, String> {
        self.0.tensor(name).map_err(|_| format!("it has no tensor `{name}`"))
    }

    /// Length of a list.
    fn length(&self, name: &str) -> Result<usize, String> {
        match self.view(name)?.shape() {
            &[length] => Ok(length),
            shape => Err(format!("`{name}` has the shape {shape:?}, expected a list")),
        }
    }

    fn data(&self, name: &str, dtype: Dtype, shape: &[usize]) -> Result<Vec<u8>, String> {
        let view = self.view(name)?;
        if view.dtype() != dtype || view.shape() != shape {
            let (got, got_shape) = (view.dtype(), view.shape());
            return Err(format!("`{name}` is {got:?} {got_shape:?}, expected {dtype:?} {shape:?}"));
        }
        Ok(view.data().to_vec())
    }

    fn f64s(&self, name: &str, shape: &[usize]) -> Result<Vec<f64>, String> {
        let data = self.data(name, Dtype::F64, shape)?;
        Ok(data.as_chunks::<8>().0.iter().map(|bytes| f64::from_le_bytes(*bytes)).collect())
    }

    fn f32s(&self, name: &str, shape: &[usize]) -> Result<Vec<f32>, String> {
        let data = self.data(name, Dtype::F32, shape)?;
        Ok(data.as_chunks::<4>().0.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect())
    }

    fn u32s(&self, name: &str, shape: &[usize]) -> Result<Vec<u32>, String> {
        let data = self.data(name, Dtype::U32, shape)?;
        Ok(data.as_chunks::<4>().0.iter().map(|bytes| u32::from_le_bytes(*bytes)).collect())
    }

    /// The format of the tokens, how many there are, and their values.
    fn tokens(&self, dim: usize) -> Result<(TokenFormat, usize, Vec<f32>), String> {
        let dtype = self.view("tokens")?.dtype();
        let storage = TokenFormat::ALL.into_iter().find(|storage| format!("{dtype:?}") == dtype_name(*storage));
        let storage = storage.ok_or_else(|| format!("its tokens are {dtype:?}, expected F32, F16 or I8"))?;
        let expected = if storage == TokenFormat::Int8 { 9 } else { 8 };
        if self.0.len() != expected {
            return Err(format!("it has {} tensors, expected {expected}", self.0.len()));
        }
        let count = self.length("token_ids")?;
        let scales = if storage == TokenFormat::Int8 { self.f32s("token_scales", &[count])? } else { Vec::new() };
        if let Some(token) = scales.iter().position(|scale| !(scale.is_finite() && *scale >= 0.0)) {
            return Err(format!("token {token} has the scale {}", scales[token]));
        }
        let bytes = self.data("tokens", dtype, &[count, dim])?;
        Ok((storage, count, storage.decode(&bytes, &scales, dim)))
    }
}
