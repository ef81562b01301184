//! Reads scene files, which may be damaged or hostile: sizes are checked before memory is allocated.

use std::path::Path;

use clift_core::{Camera, Pose, PoseNormalization};
use clift_model::{ModelConfig, ModelError, ModelPath, parse_variant};
use safetensors::{SafeTensorError, SafeTensors};

use crate::codec::token_codec::TokenCodec;
use crate::scene::coded_file::from_coded_bytes;
use crate::scene::header::{COPY_AGAIN, Fields, Refusal, refusal};
use crate::scene::scene::{CODED_VERSION, ContextGroup, FORMAT, Scene, VERSION, dtype_name, find_model, split_groups};
use crate::scene::token_coding::{TokenCoding, TokenFormat};
use crate::tensors::Tensors;

/// Longest accepted header; those of `HEADER_BYTES` are written.
const MAX_HEADER_BYTES: u64 = 1 << 16;
/// Largest accepted file: 65,536 tokens of width 768 in f32 take a fifth of it.
const MAX_FILE_BYTES: u64 = 1 << 30;
/// Largest relative difference between a stored ray, which is f32, and the ray of its camera.
const RAY_TOLERANCE: f64 = 1e-4;

const GIVE_ANOTHER: &str = "give a file that `clift encode` wrote";
const OTHER_VERSION: &str = "encode the scene again, or render it with the clift that wrote it, for versions 1 to 5 \
                             commit 51232770 or earlier";

impl Scene {
    /// Reads and checks a scene file. Coded tokens need the codec of the scene's model, see [`find_model`](Self::find_model).
    pub fn read(path: &Path) -> Result<(Self, TokenCoding), ModelError> {
        Self::read_for(path, None)
    }

    /// Reads a scene file with the codec of `model` in place of that of the scene's model path.
    pub fn read_for(path: &Path, model: Option<&Path>) -> Result<(Self, TokenCoding), ModelError> {
        let read = || {
            let size = std::fs::metadata(path).map_err(|error| refusal(error.to_string(), GIVE_ANOTHER))?.len();
            if size > MAX_FILE_BYTES {
                let reason = format!("the file has {size} bytes, a scene at most {MAX_FILE_BYTES}");
                return Err(refusal(reason, GIVE_ANOTHER));
            }
            let bytes = std::fs::read(path).map_err(|error| refusal(error.to_string(), GIVE_ANOTHER))?;
            from_bytes(&bytes, &|model_path| {
                let model = model.map_or_else(|| find_model(model_path, path), Path::to_owned);
                codec_of(&model).map_err(|error| error.to_string())
            })
        };
        let unusable =
            |Refusal { reason, fix }| ModelError::SceneFile { action: "use", reason, fix, path: path.into() };
        read().map_err(unusable)
    }
}

/// Reads the codec of a model. The number of patch grids does not change the tokens: it is the one of the model's config
/// now, not the one when the codec was fitted.
fn codec_of(model: &Path) -> Result<TokenCodec, ModelError> {
    let path = ModelPath::find(model)?;
    let mut codec = TokenCodec::read(&TokenCodec::path_of(&path.weights))?;
    codec.model.patch_grids = path.config()?.patch_grids;
    Ok(codec)
}

/// Reads a scene; `find_codec` returns the codec of a model path.
fn from_bytes(
    bytes: &[u8],
    find_codec: &dyn Fn(&str) -> Result<TokenCodec, String>,
) -> Result<(Scene, TokenCoding), Refusal> {
    check_length(bytes)?;
    let file = SafeTensors::deserialize(bytes).map_err(|error| match error {
        SafeTensorError::MetadataIncompleteBuffer => {
            refusal("the file is truncated or has bytes after its last tensor", COPY_AGAIN)
        }
        other => refusal(format!("unreadable header ({other})"), GIVE_ANOTHER),
    })?;
    let (_, metadata) = SafeTensors::read_metadata(bytes).map_err(|error| refusal(error.to_string(), GIVE_ANOTHER))?;
    let fields = Fields(metadata.metadata().clone().unwrap_or_default());
    if fields.0.get("format").map(String::as_str) != Some(FORMAT) {
        return Err(refusal("the file is not a scene: its header lacks the scene format", GIVE_ANOTHER));
    }
    let version = fields.get("version")?;
    if version == CODED_VERSION {
        let body = file.tensor("scene").map_err(|_| "no tensor `scene`".to_owned())?.data();
        return from_coded_bytes(bytes, body, &fields, find_codec);
    }
    if version != VERSION {
        let reason =
            format!("scene file of version {version}, this clift reads versions {VERSION} and {CODED_VERSION}");
        return Err(refusal(reason, OTHER_VERSION));
    }
    let kind = fields.get("kind")?;
    let kind = parse_variant(kind).ok_or_else(|| format!("unknown kind of tokens {kind:?}"))?;
    let model: ModelConfig =
        serde_json::from_str(fields.get("model")?).map_err(|error| format!("unreadable `model` ({error})"))?;

    let tensors = Tensors(file);
    let (format, num_tokens, tokens) = tensors.tokens(&model)?;
    let views = tensors.length("context_frames")?;
    let indices = |name| tensors.u32s(name, &[tensors.length(name)?]);
    let views_of_groups = split_groups(&indices("group_sizes")?, &indices("group_views")?)?;
    let num_groups = views_of_groups.len();
    let frames = tensors.f64s("group_mean_c2w", &[num_groups, 4, 4])?;
    let scales = tensors.f64s("group_scale", &[num_groups])?;
    let frames = frames.as_chunks().0.iter().zip(&scales).map(|(mean, &scale)| normalization(mean, scale));
    let groups =
        views_of_groups.into_iter().zip(frames).map(|(views, frame)| Ok(ContextGroup { views, frame: frame? }));
    let poses = tensors.f64s("context_c2w", &[views, 4, 4])?;
    let intrinsics = tensors.f64s("context_intrinsics", &[views, 4])?;
    let cameras = poses.as_chunks().0.iter().zip(intrinsics.as_chunks::<4>().0).enumerate();
    let cameras = cameras.map(|(view, (matrix, &intrinsics))| {
        let c2w = Pose::from_matrix(matrix).map_err(|error| format!("context camera {view}: {error}"))?;
        Ok(Camera { c2w, intrinsics: intrinsics.into() })
    });
    let mut mean_c2w = [0.0; 16];
    mean_c2w.copy_from_slice(&tensors.f64s("world_mean_c2w", &[4, 4])?);
    let scene = Scene {
        key: fields.get("key")?.into(),
        kind,
        renderer_hash: fields.get("renderer")?.into(),
        model_path: fields.get("model_path")?.into(),
        height: fields.count("height")?,
        width: fields.count("width")?,
        context: cameras.collect::<Result<_, String>>()?,
        context_frames: tensors.u32s("context_frames", &[views])?,
        groups: groups.collect::<Result<_, String>>()?,
        world: normalization(&mean_c2w, tensors.f64s("world_scale", &[1])?[0])?,
        token_ids: if model.has_patch_tokens() {
            tensors.u32s("token_ids", &[num_tokens])?
        } else {
            (0..num_tokens as u32).collect()
        },
        tokens,
        model,
    };
    scene.check()?;
    if scene.model.has_patch_tokens() {
        check_rays(&scene, &tensors.f32s("token_rays", &[num_tokens, 6])?)?;
    }
    Ok((scene, format.into()))
}

/// Returns a normalization from its matrix; the check of the scene checks the scale.
fn normalization(mean_c2w: &[f64; 16], scale: f64) -> Result<PoseNormalization, String> {
    let mean_c2w = Pose::from_matrix(mean_c2w).map_err(|error| format!("mean pose: {error}"))?;
    Ok(PoseNormalization { mean_c2w, scale })
}

/// Checks the length of the header before the header is parsed.
fn check_length(bytes: &[u8]) -> Result<(), Refusal> {
    let Some((length, rest)) = bytes.split_first_chunk::<8>() else {
        return Err(refusal(format!("the file is truncated: {} bytes", bytes.len()), COPY_AGAIN));
    };
    let length = u64::from_le_bytes(*length);
    if length > MAX_HEADER_BYTES {
        let reason = format!("header of {length} bytes, expected at most {MAX_HEADER_BYTES}");
        return Err(refusal(reason, GIVE_ANOTHER));
    }
    if length > rest.len() as u64 {
        let reason = format!("the file is truncated: {} bytes with a header of {length} bytes", bytes.len());
        return Err(refusal(reason, COPY_AGAIN));
    }
    Ok(())
}

/// Checks that the stored rays, which are for other programs, are those of the cameras.
fn check_rays(scene: &Scene, rays: &[f32]) -> Result<(), String> {
    for (token, (stored, expected)) in rays.as_chunks::<6>().0.iter().zip(scene.plucker_rays()).enumerate() {
        let scale = expected.iter().fold(1.0, |most: f64, value| most.max(value.abs()));
        let is_close = |(a, b): (&f32, &f64)| (f64::from(*a) - b).abs() <= RAY_TOLERANCE * scale;
        if !stored.iter().zip(&expected).all(is_close) {
            return Err(format!("ray of token {token}: {stored:?}, expected {expected:?} from its camera"));
        }
    }
    Ok(())
}

impl Tensors<'_> {
    fn tokens(&self, model: &ModelConfig) -> Result<(TokenFormat, usize, Vec<f32>), String> {
        // Its sizes bound what is allocated below.
        model.validate().map_err(|error| error.to_string())?;
        let dtype = self.view("tokens")?.dtype();
        let format = TokenFormat::ALL.into_iter().find(|format| format!("{dtype:?}") == dtype_name(*format));
        let format = format.ok_or_else(|| format!("`tokens` is {dtype:?}, expected F32 or F16"))?;
        let expected = if model.has_patch_tokens() { 12 } else { 10 };
        if self.0.len() != expected {
            return Err(format!("{} tensors, expected {expected}", self.0.len()));
        }
        let count = model.num_learned_tokens().map_or_else(|| self.length("token_ids"), Ok)?;
        let bytes = self.data("tokens", dtype, &[count, model.dim])?;
        Ok((format, count, format.decode(&bytes)))
    }
}
