//! Problems of the keys of a checkpoint, and their message: one line for equal keys of all layers.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;

use clift_data::{ElementType, StateDict};
use clift_model::{CliftVariant, ModelConfig, PublishedTensor, canonical_key, published_tensors};

use crate::interchange::keys::{Keys, pattern, printable};
use crate::interchange::record::ImportOptions;

/// Most lines; a network has about sixty patterns of keys.
const MAX_LISTED: usize = 200;

pub(crate) struct Problem {
    kind: Kind,
    /// The key in the file, or the expected key.
    key: String,
    /// Shapes and formats.
    detail: String,
}

#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, strum::Display)]
#[strum(serialize_all = "lowercase")]
enum Kind {
    Misshapen,
    #[strum(to_string = "not in f32")]
    NotF32,
    #[strum(to_string = "no tensor")]
    NoTensor,
    Missing,
    Unknown,
    #[strum(to_string = "beside transformer.")]
    Stray,
}

/// Compares a checkpoint with the expected tensors of a network.
pub(crate) fn problems(
    keys: &Keys,
    state: &StateDict,
    expected: &[PublishedTensor],
    options: &ImportOptions,
) -> Vec<Problem> {
    let mut problems = Vec::new();
    let known: BTreeSet<&str> = expected.iter().map(|tensor| tensor.key.as_str()).collect();
    let is_convertible = |got| matches!(got, ElementType::F16 | ElementType::BF16 | ElementType::F64);
    for tensor in expected {
        let (name, expected) = (tensor.key.clone(), &tensor.shape);
        let key = keys.network.get(&name);
        let (kind, detail) = match key.map(|key| state.tensor(key)) {
            None => (Kind::Missing, format!(" {expected:?}")),
            Some(None) => (Kind::NoTensor, format!(", expected {expected:?}")),
            Some(Some((_, shape))) if !tensor.fits(shape) => {
                (Kind::Misshapen, format!(" is {shape:?}, expected {expected:?}"))
            }
            Some(Some((got, shape))) if got != ElementType::F32 && !(options.convert && is_convertible(got)) => {
                let fix = if is_convertible(got) { "; --convert converts it to f32" } else { "" };
                (Kind::NotF32, format!(" {shape:?} is {got:?}{fix}"))
            }
            Some(Some(_)) => continue,
        };
        let key = key.cloned().unwrap_or_else(|| format!("{}{name}", keys.prefix));
        problems.push(Problem { kind, key, detail });
    }
    let unknown = keys.network.iter().filter(|(name, _)| !known.contains(name.as_str()));
    let unknown = unknown.map(|(name, key)| (Kind::Unknown, keys.prefix, name, key));
    let strays = keys.strays.iter().map(|(name, key)| (Kind::Stray, "", name, key));
    for (kind, prefix, name, key) in unknown.chain(strays) {
        let mut detail = state.tensor(key).map_or_else(String::new, |(_, shape)| format!(" {shape:?}"));
        let full = format!("{prefix}{name}");
        if canonical_key(key) != full {
            let _ = write!(detail, ", renamed {}", printable(&pattern(&full)));
        }
        problems.push(Problem { kind, key: key.clone(), detail });
    }
    problems
}

/// Lists the problems, and suggests another variant or a rename.
pub(crate) fn describe(
    keys: &Keys,
    state: &StateDict,
    problems: &[Problem],
    model: &ModelConfig,
    options: &ImportOptions,
) -> String {
    let ModelConfig { variant, dim, num_heads, num_encoder_blocks, num_renderer_blocks, .. } = model;
    let mut text = format!(
        "the checkpoint is not a {variant} network (width {dim}, {num_heads} heads, {num_encoder_blocks} + \
         {num_renderer_blocks} layers); no files were written"
    );
    let mut lines: BTreeMap<(Kind, String, &str), Vec<&str>> = BTreeMap::new();
    for Problem { kind, key, detail } in problems {
        lines.entry((*kind, pattern(key), detail)).or_default().push(key);
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
    let fitting = CliftVariant::ALL.into_iter().filter(|other| *other != options.variant).find(|other| {
        let sizes = keys.sizes(state, *other, options.num_heads);
        let options = ImportOptions { convert: true, ..options.clone() };
        sizes.config.validate().is_ok()
            && self::problems(keys, state, &published_tensors(&sizes.config, sizes.has_condenser), &options).is_empty()
    });
    if let Some(other) = fitting {
        let _ = write!(text, "\n  keys and shapes match --variant {other}");
    } else if problems.iter().any(|problem| matches!(problem.kind, Kind::Unknown | Kind::Stray)) {
        text.push_str("\n  --rename FROM=TO replaces a part of the keys listed here");
    }
    text + "\n "
}
