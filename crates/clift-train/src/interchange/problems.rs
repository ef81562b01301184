//! Problems of the keys of a checkpoint, and their message: one line for equal keys of all layers.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;

use clift_data::{ElementType, StateDict};
use clift_model::{CliftVariant, ModelConfig, PublishedTensor, published_tensors};

use crate::interchange::keys::{Keys, pattern, printable};

/// Most lines; a network has about sixty patterns of keys.
const MAX_LISTED: usize = 200;

pub(crate) struct Problem {
    kind: &'static str,
    /// The key in the file, or the expected key.
    key: String,
    /// Shapes and formats.
    detail: String,
}

/// Compares a checkpoint with the expected tensors of a network.
pub(crate) fn problems(keys: &Keys, state: &StateDict, expected: &[PublishedTensor]) -> Vec<Problem> {
    let mut problems = Vec::new();
    let known: BTreeSet<&str> = expected.iter().map(|tensor| tensor.key.as_str()).collect();
    let floats = [ElementType::F32, ElementType::F16, ElementType::BF16, ElementType::F64];
    for tensor in expected {
        let (name, expected) = (&tensor.key, &tensor.shape);
        let key = keys.network.get(name);
        let (kind, detail) = match key.map(|key| state.tensor(key)) {
            None => ("missing", format!(" {expected:?}")),
            Some(None) => ("no tensor", format!(", expected {expected:?}")),
            Some(Some((_, shape))) if !tensor.fits(shape) => {
                ("misshapen", format!(" is {shape:?}, expected {expected:?}"))
            }
            Some(Some((got, shape))) if !floats.contains(&got) => ("not in f32", format!(" {shape:?} is {got:?}")),
            Some(Some(_)) => continue,
        };
        let key = key.cloned().unwrap_or_else(|| format!("{}{name}", keys.prefix));
        problems.push(Problem { kind, key, detail });
    }
    let unknown = keys.network.iter().filter(|(name, _)| !known.contains(name.as_str()));
    for (_, key) in unknown {
        let detail = state.tensor(key).map_or_else(String::new, |(_, shape)| format!(" {shape:?}"));
        problems.push(Problem { kind: "unknown", key: key.clone(), detail });
    }
    problems
}

/// Lists the problems, and suggests another variant.
pub(crate) fn describe(
    keys: &Keys,
    state: &StateDict,
    problems: &[Problem],
    model: &ModelConfig,
    given_heads: Option<usize>,
) -> String {
    let ModelConfig { variant, dim, num_heads, num_encoder_blocks, num_renderer_blocks, .. } = model;
    let mut text = format!(
        "the checkpoint is not a {variant} network (width {dim}, {num_heads} heads, {num_encoder_blocks} + \
         {num_renderer_blocks} layers); no files were written"
    );
    let mut lines: BTreeMap<(&str, String, &str), Vec<&str>> = BTreeMap::new();
    for Problem { kind, key, detail } in problems {
        lines.entry((kind, pattern(key), detail)).or_default().push(key);
    }
    for ((kind, pattern, detail), found) in lines.iter().take(MAX_LISTED) {
        let _ = match found[..] {
            [key] => write!(text, "\n  {kind}: {}{detail}", printable(key)),
            _ => write!(text, "\n  {kind}: {}{detail} ({} keys)", printable(pattern), found.len()),
        };
    }
    if lines.len() > MAX_LISTED {
        let _ = write!(text, "\n  and {} more", lines.len() - MAX_LISTED);
    }
    let fitting = CliftVariant::ALL.into_iter().filter(|other| other != variant).find(|other| {
        let sizes = keys.sizes(state, *other, given_heads);
        let expected = published_tensors(&sizes.config, sizes.has_condenser);
        sizes.config.validate().is_ok() && self::problems(keys, state, &expected).is_empty()
    });
    if let Some(other) = fitting {
        let _ = write!(text, "\n  keys and shapes match --variant {other}");
    }
    text + "\n "
}
