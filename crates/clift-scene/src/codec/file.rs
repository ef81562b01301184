//! `codec.safetensors`: the codec of a model, beside its weights.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use clift_core::replace_file;
use clift_model::{ModelConfig, ModelError, TokenKind, parse_variant, sorted_header};
use safetensors::tensor::{Dtype, TensorView};
use safetensors::{SafeTensors, serialize};
use sha2::{Digest, Sha256};

use crate::codec::histogram::Distributions;
use crate::codec::prediction::{NUM_CLASSES, Prediction};
use crate::codec::rates::RateTable;
use crate::codec::token_codec::TokenCodec;
use crate::codec::transform::Transform;
use crate::tensors::{Tensors, f32_bytes, f64_bytes};

const FORMAT: &str = "clift-codec";
const VERSION: &str = "2";
/// Largest accepted file: a codec of width 4,096 takes a tenth of it.
const MAX_FILE_BYTES: u64 = 1 << 30;

impl TokenCodec {
    /// Makes the codec of a fitted transform.
    pub fn new(
        (model, kind, renderer_hash): (ModelConfig, TokenKind, String),
        (transform, prediction): (Transform, Prediction),
        distributions: Distributions,
        rates: RateTable,
    ) -> Result<Self, ModelError> {
        let mut codec = Self {
            model,
            kind,
            renderer_hash,
            transform,
            prediction,
            distributions,
            rates: rates.checked()?,
            hash: String::new(),
        };
        let bad = |fix| ModelError::BadConfig { key: "codec", value: codec.renderer_hash.clone(), fix };
        codec.hash = hash(&to_bytes(&codec).map_err(bad)?);
        Ok(codec)
    }

    /// Returns the path of the codec of a weight file: `codec*.safetensors` beside `model*.safetensors`,
    /// `NAME.codec.safetensors` beside another file. The file need not exist.
    pub fn path_of(weights: &Path) -> PathBuf {
        let name = weights.file_name().unwrap_or_default().to_string_lossy();
        match name.strip_prefix("model").filter(|rest| rest.ends_with(".safetensors")) {
            Some(rest) => weights.with_file_name(format!("codec{rest}")),
            None => weights.with_extension("codec.safetensors"),
        }
    }

    /// Writes the codec.
    pub fn write(&self, path: &Path) -> Result<(), ModelError> {
        let written = to_bytes(self).and_then(|bytes| replace_file(path, &bytes).map_err(|error| error.to_string()));
        written.map_err(|reason| ModelError::CodecFile { action: "writing", reason, path: path.into() })
    }

    /// Reads and checks a codec.
    pub fn read(path: &Path) -> Result<Self, ModelError> {
        let size = match std::fs::metadata(path) {
            Ok(found) if found.is_file() => found.len(),
            _ => return Err(ModelError::NoCodec { path: path.into() }),
        };
        let read = || {
            if size > MAX_FILE_BYTES {
                return Err(format!("the file has {size} bytes, a codec at most {MAX_FILE_BYTES}"));
            }
            from_bytes(&std::fs::read(path).map_err(|error| error.to_string())?)
        };
        read().map_err(|reason| ModelError::CodecFile { action: "reading", reason, path: path.into() })
    }
}

/// Returns the first 16 hexadecimal digits of the SHA-256 of a codec's file.
fn hash(bytes: &[u8]) -> String {
    hex::encode(&Sha256::digest(bytes)[..8])
}

fn to_bytes(codec: &TokenCodec) -> Result<Vec<u8>, String> {
    let TokenCodec { model, kind, renderer_hash, transform, prediction, distributions, rates, .. } = codec;
    let (dim, knots) = (transform.mean.len(), distributions.knots.len());
    let (counts, steps) = (rates.shares.len(), rates.steps.len());
    let f32s = |values: &[f32]| f32_bytes(values.iter().copied());
    let f64s = |values: &[f64]| f64_bytes(values.iter().copied());
    let tensors = [
        ("mean", Dtype::F32, vec![dim], f32s(&transform.mean)),
        ("basis", Dtype::F32, vec![dim, dim], f32s(&transform.basis)),
        ("deviations", Dtype::F32, vec![dim], f32s(&transform.deviations)),
        ("knots", Dtype::F32, vec![knots], f32s(&distributions.knots)),
        ("cumulative", Dtype::F32, vec![dim, knots], f32s(&distributions.cumulative)),
        ("rate_shares", Dtype::F64, vec![counts], f64s(&rates.shares)),
        ("rate_steps", Dtype::F64, vec![steps], f64s(&rates.steps)),
        ("rate_loss", Dtype::F64, vec![counts, steps], f64s(&rates.loss)),
        ("weights", Dtype::F32, vec![NUM_CLASSES, dim, 2], f32s(&prediction.weights)),
        ("scales", Dtype::F32, vec![NUM_CLASSES, dim], f32s(&prediction.scales)),
    ];
    let views: Result<Vec<_>, _> = tensors
        .iter()
        .map(|(name, dtype, shape, data)| Ok((*name, TensorView::new(*dtype, shape.clone(), data)?)))
        .collect();
    let metadata = HashMap::from([
        ("format".to_owned(), FORMAT.to_owned()),
        ("version".to_owned(), VERSION.to_owned()),
        ("kind".to_owned(), kind.name().to_owned()),
        ("model".to_owned(), serde_json::to_string(model).map_err(|error| error.to_string())?),
        ("renderer".to_owned(), renderer_hash.clone()),
    ]);
    let bytes = views.and_then(|views| serialize(views, Some(metadata))).map_err(|error| error.to_string())?;
    sorted_header(bytes).map_err(|error| error.to_string())
}

fn from_bytes(bytes: &[u8]) -> Result<TokenCodec, String> {
    let text = |error: safetensors::SafeTensorError| error.to_string();
    let (_, header) = SafeTensors::read_metadata(bytes).map_err(text)?;
    let file = SafeTensors::deserialize(bytes).map_err(text)?;
    let metadata = header.metadata().clone().unwrap_or_default();
    let field = |name: &str| metadata.get(name).ok_or_else(|| format!("no `{name}` in the header"));
    let [format, version] = [field("format")?, field("version")?];
    if format != FORMAT {
        return Err(format!("format {format:?}, expected {FORMAT:?}"));
    }
    if version != VERSION {
        return Err(format!("version {version}, this clift reads version {VERSION}; fit it again with `clift codec`"));
    }
    let model: ModelConfig =
        serde_json::from_str(field("model")?).map_err(|error| format!("unreadable `model` ({error})"))?;
    model.validate().map_err(|error| error.to_string())?;
    let kind = field("kind")?;
    let kind = parse_variant(kind).ok_or_else(|| format!("unknown kind of tokens {kind:?}"))?;
    let file = Tensors(file);
    let f32s = |name: &str, shape: &[usize]| {
        let values = file.f32s(name, shape)?;
        match values.iter().find(|value| !value.is_finite()) {
            Some(value) => Err(format!("`{name}` contains {value}")),
            None => Ok(values),
        }
    };
    let (dim, knots) = (model.dim, file.length("knots")?);
    let (counts, steps) = (file.length("rate_shares")?, file.length("rate_steps")?);
    let transform = Transform {
        mean: f32s("mean", &[dim])?,
        basis: f32s("basis", &[dim, dim])?,
        deviations: f32s("deviations", &[dim])?,
    };
    let distributions =
        Distributions { knots: f32s("knots", &[knots])?, cumulative: f32s("cumulative", &[dim, knots])? };
    let prediction =
        Prediction { weights: f32s("weights", &[NUM_CLASSES, dim, 2])?, scales: f32s("scales", &[NUM_CLASSES, dim])? };
    if let Some(scale) = prediction.scales.iter().find(|scale| **scale <= 0.0) {
        return Err(format!("scale {scale}, expected a positive number"));
    }
    check_transform(&transform)?;
    check_distributions(&distributions)?;
    let rates = RateTable {
        shares: file.f64s("rate_shares", &[counts])?,
        steps: file.f64s("rate_steps", &[steps])?,
        loss: file.f64s("rate_loss", &[counts, steps])?,
    };
    let rates = rates.checked().map_err(|error| error.to_string())?;
    let renderer_hash = field("renderer")?.clone();
    Ok(TokenCodec { model, kind, renderer_hash, transform, prediction, distributions, rates, hash: hash(bytes) })
}

fn check_transform(transform: &Transform) -> Result<(), String> {
    if let Some(d) = transform.deviations.iter().position(|deviation| *deviation <= 0.0) {
        return Err(format!("deviation {} of direction {d}, expected a positive number", transform.deviations[d]));
    }
    let length = |d: usize| transform.direction(d).iter().map(|value| value * value).sum::<f32>();
    match (0..transform.mean.len()).find(|&d| !length(d).is_normal()) {
        Some(d) => Err(format!("direction {d} has no length")),
        None => Ok(()),
    }
}

fn check_distributions(distributions: &Distributions) -> Result<(), String> {
    let Distributions { knots, cumulative } = distributions;
    if knots.len() < 2 || !knots.windows(2).all(|pair| pair[0] < pair[1]) {
        return Err("the knots are not ascending numbers".into());
    }
    let is_distribution =
        |row: &[f32]| row[0] == 0.0 && row[row.len() - 1] == 1.0 && row.windows(2).all(|pair| pair[0] <= pair[1]);
    match cumulative.chunks_exact(knots.len()).position(|row| !is_distribution(row)) {
        Some(d) => Err(format!("the probabilities of direction {d} do not ascend from 0 to 1")),
        None => Ok(()),
    }
}
