//! A published checkpoint to a model directory: weights, config, and what came from where.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use clift_data::StateDict;
use clift_data::pickle::ElementType;
use clift_model::interchange::{self, CheckpointTensor, PREFIX, PROJECTIONS, plain_key};
use clift_model::{ModelConfig, Variant};
use serde::{Deserialize, Serialize};

use crate::TrainError;
use crate::config::Config;
use crate::keys::nearest;
use crate::model_dir::{self, Parameter};

/// Keys of one kind that a message lists.
const MAX_LISTED: usize = 12;
/// Letters of a key that a message shows.
const MAX_SHOWN: usize = 160;
/// Keys that are looked through for the nearest.
const MAX_COMPARED: usize = 1000;
/// Kinds of keys outside the network that are told apart.
const MAX_IGNORED: usize = 64;

/// What the user says about a checkpoint.
#[derive(Clone, Debug)]
pub struct ImportOptions {
    /// Which network it holds.
    pub variant: Variant,
    /// Its heads, where no shape shows them.
    pub num_heads: Option<usize>,
    /// Whether parameters that are not in f32 are converted to it; they are an error otherwise.
    pub convert: bool,
    /// Texts that are replaced in keys: `(from, to)`.
    pub renames: Vec<(String, String)>,
}

/// What an import did; `import.json` of the model directory.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Imported {
    /// Version of this file.
    pub version: u32,
    /// Name of the checkpoint.
    pub file: String,
    /// SHA-256 of its bytes.
    pub sha256: String,
    /// The network.
    pub variant: Variant,
    /// Whether it has a condenser, as a second-stage checkpoint has.
    pub has_condenser: bool,
    /// Projections that are 1x1 convolutions there; `clift export` writes them so.
    pub convolutions: Vec<String>,
    /// Parameters that were not in f32.
    pub num_converted: usize,
    /// Keys of the checkpoint, each with the parameters it became.
    pub parameters: Vec<(String, Vec<String>)>,
    /// First parts of keys that are no part of the network, each with how many keys there are.
    pub ignored: BTreeMap<String, usize>,
    /// Python classes and functions that were passed over, with the objects made of them.
    pub passed_over: BTreeSet<String>,
}

/// Reads a checkpoint and writes a model directory: all of it or nothing.
///
/// # Errors
/// [`TrainError::BadFile`] where keys, shapes or number formats are not the network's, with all of them;
/// [`TrainError::BadConfig`] for heads that cannot be; whatever reading the file or writing the directory gives.
pub fn import(file: &Path, out: &Path, options: &ImportOptions) -> Result<(Config, Imported), TrainError> {
    model_dir::refuse_existing(out)?;
    let state = StateDict::open(file)?;
    let keys = Keys::of(&state, options)?;
    let (model, has_condenser) = keys.sizes(&state, options.variant, options.num_heads);
    check_sizes(&model, options, file)?;
    let expected = interchange::tensors(&model, has_condenser);
    let problems = keys.problems(&state, &expected, options.convert);
    if !problems.is_empty() {
        return Err(TrainError::bad_file("checkpoint", file)(keys.told(&state, problems, &model, options)));
    }

    let num_bytes: u64 = expected.iter().map(|tensor| 4 * tensor.shape.iter().product::<usize>() as u64).sum();
    // Keys may share a storage, which a network's parameters do not.
    if num_bytes > state.num_bytes().saturating_mul(2) {
        let reason = format!("its parameters take {num_bytes} bytes, more than twice the {} it has", state.num_bytes());
        return Err(TrainError::bad_file("checkpoint", file)(reason));
    }
    let (mut parameters, mut mapping, mut convolutions, mut num_converted) = (vec![], vec![], vec![], 0);
    for tensor in &expected {
        let key = &keys.network[&tensor.key];
        let values = state.read(key)?;
        let (element_type, shape) = state.tensor(key).unwrap_or((ElementType::F32, &[]));
        num_converted += usize::from(element_type != ElementType::F32);
        if shape.len() == 4 {
            convolutions.push(tensor.key.trim_end_matches(".weight").to_owned());
        }
        parameters.extend(parts(tensor, &values));
        mapping.push((key.clone(), tensor.parts.iter().map(|(path, _)| path.clone()).collect()));
    }
    let imported = Imported {
        version: 1,
        file: file.file_name().unwrap_or_default().to_string_lossy().into_owned(),
        sha256: model_dir::sha256(file)?,
        variant: options.variant,
        has_condenser,
        convolutions,
        num_converted,
        parameters: mapping,
        ignored: keys.ignored,
        passed_over: state.passed_over().clone(),
    };
    let config = model_dir::evaluation_config(model, out);
    model_dir::write(out, &config, &parameters, &imported)?;
    Ok((config, imported))
}

/// A key that no shape shows must be right before anything else can be said.
fn check_sizes(model: &ModelConfig, options: &ImportOptions, file: &Path) -> Result<(), TrainError> {
    let num_heads = model.num_heads;
    if num_heads == 0 || !model.dim.is_multiple_of(num_heads) {
        let given = options.num_heads.map_or_else(|| format!("{num_heads} (the published)"), |heads| heads.to_string());
        let fix = format!("give the heads of this network, a divisor of its width {}", model.dim);
        return Err(TrainError::BadConfig { key: "--num-heads".into(), value: given, fix });
    }
    let bad_sizes = |error: clift_model::ModelError| TrainError::bad_file("checkpoint", file)(error);
    model.validate().map_err(bad_sizes)
}

/// The rows of a tensor that are parameters here.
fn parts<'a>(tensor: &'a CheckpointTensor, values: &'a [f32]) -> impl Iterator<Item = Parameter> + 'a {
    let row_len: usize = tensor.shape[1..].iter().product();
    tensor.parts.iter().map(move |(path, rows)| {
        let mut shape = tensor.shape.clone();
        shape[0] = rows.len();
        let values = values[rows.start * row_len..rows.end * row_len].to_vec();
        Parameter { path: path.clone(), shape, values }
    })
}

/// The keys of a checkpoint.
struct Keys {
    /// Those of the network: as `interchange` writes them, and as the file does.
    network: BTreeMap<String, String>,
    /// First parts of the others, and how many of them there are.
    ignored: BTreeMap<String, usize>,
}

/// What is wrong with one key.
enum Problem {
    Missing(CheckpointTensor),
    Unknown(String),
    Shape { key: String, got: Vec<u64>, expected: Vec<usize> },
    Format { key: String, got: ElementType, shape: Vec<u64>, is_convertible: bool },
    NoTensor(String),
}

impl Problem {
    fn kind(&self) -> &'static str {
        match self {
            Self::Missing(_) => "missing",
            Self::Unknown(_) => "unknown",
            Self::Shape { .. } => "misshapen",
            Self::Format { .. } => "not in f32",
            Self::NoTensor(_) => "no tensor",
        }
    }

    fn told(&self, state: &StateDict, missing: &[&str], unknown: &[&str]) -> String {
        match self {
            Self::Missing(tensor) => format!("{} {:?}{}", tensor.key, tensor.shape, near(&tensor.key, unknown)),
            Self::Unknown(key) => {
                let shape = state.tensor(key).map_or_else(String::new, |(_, shape)| format!(" {shape:?}"));
                format!("{}{shape}{}", shown(key), near(plain(key), missing))
            }
            Self::Shape { key, got, expected } => format!("{} is {got:?}, expected {expected:?}", shown(key)),
            Self::Format { key, got, shape, is_convertible } => {
                let fix = if *is_convertible { "; --convert converts it to f32" } else { "" };
                format!("{} {shape:?} is {got:?}{fix}", shown(key))
            }
            Self::NoTensor(key) => shown(key),
        }
    }
}

/// The candidate that a word may be a slip of. Only so many words and letters are compared: a file decides how many
/// there are.
fn near(word: &str, candidates: &[&str]) -> String {
    let short = |word: &&str| word.len() <= MAX_SHOWN;
    let found = Some(word).filter(short).and_then(|word| {
        let candidates = candidates.iter().copied().filter(short).take(MAX_COMPARED);
        nearest(word, candidates)
    });
    found.map_or_else(String::new, |name| format!("; nearest name: {}", shown(name)))
}

/// A key without the network's prefix.
fn plain(key: &str) -> &str {
    key.strip_prefix(PREFIX).unwrap_or(key)
}

/// A key of a file that may be hostile, for a terminal.
fn shown(key: &str) -> String {
    let short: String = key.chars().take(MAX_SHOWN).collect();
    let rest = if short.len() < key.len() { ".." } else { "" };
    format!("{}{rest}", short.escape_debug())
}

impl Keys {
    fn of(state: &StateDict, options: &ImportOptions) -> Result<Self, TrainError> {
        // A state dict saved on its own has no prefix.
        let prefix = if state.keys().any(|key| key.starts_with(PREFIX)) { PREFIX } else { "" };
        let (mut network, mut ignored) = (BTreeMap::new(), BTreeMap::new());
        for key in state.keys() {
            let Some(name) = key.strip_prefix(prefix).filter(|_| !key.starts_with(interchange::PERCEPTUAL_PREFIX))
            else {
                let first = shown(key.split('.').next().unwrap_or_default());
                let is_known = ignored.contains_key(&first) || ignored.len() < MAX_IGNORED;
                *ignored.entry(if is_known { first } else { "others".into() }).or_insert(0) += 1;
                continue;
            };
            let renamed = options.renames.iter().fold(name.to_owned(), |name, (from, to)| name.replace(from, to));
            if let Some(other) = network.insert(plain_key(&renamed), key.to_owned()) {
                let (other, key, name) = (shown(&other), shown(key), shown(&plain_key(&renamed)));
                let reason = format!("{other} and {key} are both {name}");
                return Err(TrainError::bad_file("checkpoint", state.path())(reason));
            }
        }
        Ok(Self { network, ignored })
    }

    fn sizes(&self, state: &StateDict, variant: Variant, num_heads: Option<usize>) -> (ModelConfig, bool) {
        let shape = |name: &str| state.tensor(self.network.get(name)?).map(|(_, shape)| shape.to_vec());
        interchange::sizes(variant, num_heads, self.network.keys().map(String::as_str), shape)
    }

    fn problems(&self, state: &StateDict, expected: &[CheckpointTensor], convert: bool) -> Vec<Problem> {
        let mut problems = Vec::new();
        let mut known = BTreeSet::new();
        for tensor in expected {
            known.insert(tensor.key.as_str());
            let Some(key) = self.network.get(&tensor.key) else {
                problems.push(Problem::Missing(tensor.clone()));
                continue;
            };
            let Some((got, shape)) = state.tensor(key) else {
                problems.push(Problem::NoTensor(key.clone()));
                continue;
            };
            let is_convertible = matches!(got, ElementType::F16 | ElementType::BF16 | ElementType::F64);
            if !tensor.fits(shape) {
                let (key, got, expected) = (key.clone(), shape.to_vec(), tensor.shape.clone());
                problems.push(Problem::Shape { key, got, expected });
            } else if got != ElementType::F32 && !(convert && is_convertible) {
                problems.push(Problem::Format { key: key.clone(), got, shape: shape.to_vec(), is_convertible });
            }
        }
        let unknown = self.network.iter().filter(|(name, _)| !known.contains(name.as_str()));
        problems.extend(unknown.map(|(_, key)| Problem::Unknown(key.clone())));
        problems
    }

    /// All that is wrong, for people.
    fn told(&self, state: &StateDict, problems: Vec<Problem>, model: &ModelConfig, options: &ImportOptions) -> String {
        let ModelConfig { variant, dim, num_heads, num_encoder_blocks, num_renderer_blocks, .. } = model;
        let mut text = format!(
            "it does not hold a {variant} network (width {dim}, {num_heads} heads, {num_encoder_blocks} + \
             {num_renderer_blocks} layers); nothing was written"
        );
        let missing: Vec<&str> = problems
            .iter()
            .filter_map(|problem| match problem {
                Problem::Missing(tensor) => Some(tensor.key.as_str()),
                _ => None,
            })
            .collect();
        let unknown: Vec<&str> = problems
            .iter()
            .filter_map(|problem| match problem {
                Problem::Unknown(key) => Some(plain(key)),
                _ => None,
            })
            .collect();
        let mut listed = BTreeMap::new();
        for problem in &problems {
            let kind = problem.kind();
            let count = listed.entry(kind).or_insert(0_usize);
            *count += 1;
            if *count <= MAX_LISTED {
                let _ = write!(text, "\n  {kind}: {}", problem.told(state, &missing, &unknown));
            }
        }
        for (kind, count) in listed.into_iter().filter(|(_, count)| *count > MAX_LISTED) {
            let _ = write!(text, "\n  {kind}: {} more", count - MAX_LISTED);
        }
        let fitting = Variant::ALL.into_iter().filter(|other| *other != options.variant).find(|other| {
            let (model, has_condenser) = self.sizes(state, *other, options.num_heads);
            let fits = model.validate().is_ok();
            fits && self.problems(state, &interchange::tensors(&model, has_condenser), true).is_empty()
        });
        if let Some(other) = fitting {
            let _ = write!(text, "\n  its keys and shapes are those of --variant {other}");
        } else if !unknown.is_empty() && !missing.is_empty() {
            let _ = write!(text, "\n  --rename FROM=TO replaces a part of its keys");
        }
        text.push_str("\n ");
        text
    }
}

impl Imported {
    /// Reads the record of a model directory; `None` for a model that was trained here.
    ///
    /// # Errors
    /// [`TrainError::BadFile`] for a damaged file.
    pub fn read(folder: &Path) -> Result<Option<Self>, TrainError> {
        let path: PathBuf = folder.join("import.json");
        if !path.exists() {
            return Ok(None);
        }
        let text = std::fs::read(&path).map_err(TrainError::io("reading what was imported", &path))?;
        let imported: Self = serde_json::from_slice(&text).map_err(TrainError::bad_file("import.json", &path))?;
        if let Some(layer) = imported.convolutions.iter().find(|layer| !PROJECTIONS.contains(&layer.as_str())) {
            let reason = format!("{layer:?} is no projection");
            return Err(TrainError::bad_file("import.json", &path)(reason));
        }
        Ok(Some(imported))
    }
}

#[cfg(test)]
mod tests;
