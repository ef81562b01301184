//! Problems of the keys of a checkpoint, and their message: one line for equal keys of all layers, with the nearest name.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;

use clift_data::{ElementType, StateDict};
use clift_model::{CliftVariant, ModelConfig, PREFIX, PublishedTensor, canonical_key, published_tensors};

use crate::interchange::keys::{Keys, MAX_SHOWN, is_number, pattern, printable};
use crate::interchange::record::ImportOptions;

/// Most lines of one kind; a network has about sixty patterns of keys.
const MAX_LISTED: usize = 200;
/// Most layer numbers in a line.
const MAX_NUMBERS: usize = 64;

pub(crate) struct Problem {
    kind: Kind,
    /// The key in the file, or the expected key.
    key: String,
    /// The canonical name.
    name: String,
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
        problems.push(Problem { kind, key, name, detail });
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
        problems.push(Problem { kind, key: key.clone(), name: name.clone(), detail });
    }
    problems
}

struct PatternNames<'a>(BTreeMap<String, BTreeSet<&'a str>>);

impl<'a> PatternNames<'a> {
    fn of(names: impl Iterator<Item = &'a str>) -> Self {
        let mut patterns: BTreeMap<_, BTreeSet<_>> = BTreeMap::new();
        for name in names {
            patterns.entry(pattern(name)).or_default().insert(name);
        }
        Self(patterns)
    }

    /// Returns the pattern with the smallest edit distance, if that is at most `most`.
    fn nearest(&self, name: &str, most: usize) -> Option<&str> {
        let short = |text: &str| text.chars().take(MAX_SHOWN).collect::<String>();
        let word = short(&pattern(name));
        let distance = |candidate: &str| strsim::damerau_levenshtein(&word, &short(candidate));
        let all = self.0.keys().take(MAX_LISTED).map(|candidate| (distance(candidate), candidate.as_str()));
        all.filter(|(distance, _)| *distance <= most)
            .min_by_key(|(distance, _)| *distance)
            .map(|(_, candidate)| candidate)
    }

    /// Returns the name of a pattern with these numbers, or the only name, or the pattern.
    fn name_of(&self, found: &str, numbers: Option<&[&str]>) -> String {
        let mut numbers = numbers.unwrap_or_default().iter();
        let part = |part| if part == "N" { numbers.next().copied().unwrap_or(part) } else { part };
        let filled = found.split('.').map(part).collect::<Vec<_>>().join(".");
        let names = &self.0[found];
        match names.first() {
            _ if names.contains(filled.as_str()) => filled,
            Some(first) if names.len() == 1 => (*first).to_owned(),
            _ => found.to_owned(),
        }
    }
}

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
    let [missing, unknown, strays] = [Kind::Missing, Kind::Unknown, Kind::Stray].map(|kind| {
        let found = problems.iter().filter(|problem| problem.kind == kind);
        PatternNames::of(found.map(|problem| problem.name.as_str()))
    });
    let expected = published_tensors(model, true);
    let expected = PatternNames::of(expected.iter().map(|tensor| tensor.key.as_str()));
    let mut lines: BTreeMap<(Kind, String, &str), Vec<&Problem>> = BTreeMap::new();
    for problem in problems {
        lines.entry((problem.kind, pattern(&problem.key), &problem.detail)).or_default().push(problem);
    }
    let mut counts = BTreeMap::new();
    for ((kind, pattern, detail), found) in lines {
        let count = counts.entry(kind).or_insert(0_usize);
        *count += 1;
        if *count > MAX_LISTED {
            continue;
        }
        let first = found[0];
        let (key, numbers) = match found.len() {
            1 => (&first.key, String::new()),
            _ => (&pattern, format!(" (N = {})", layer_numbers(&found))),
        };
        let _ = write!(text, "\n  {kind}: {}{detail}{numbers}", printable(key));
        let (own, most) = (numbers_of(&first.name), first.name.len() / 2);
        let prefixed = |name: String| format!("{}{name}", keys.prefix);
        let own = (found.len() == 1).then_some(&own[..]);
        let near = match kind {
            // Possibly this key under another name; strays lack the prefix.
            Kind::Missing => {
                let near =
                    |names: &PatternNames| names.nearest(&first.name, most).map(|found| names.name_of(found, own));
                near(&strays).or_else(|| near(&unknown).map(prefixed))
            }
            Kind::Unknown | Kind::Stray => {
                let missing = missing.nearest(&first.name, most).map(|found| missing.name_of(found, own));
                let near = missing
                    .or_else(|| expected.nearest(&first.name, usize::MAX).map(|found| expected.name_of(found, own)));
                near.map(prefixed)
            }
            _ => None,
        };
        if let Some(near) = near {
            let _ = write!(text, "; nearest name: {}", printable(&near));
        }
    }
    for (kind, count) in counts.iter().filter(|(_, count)| **count > MAX_LISTED) {
        let _ = write!(text, "\n  {kind}: {} more", count - MAX_LISTED);
    }
    text.push_str(&suggest_fix(keys, state, options, !unknown.0.is_empty() || !strays.0.is_empty()));
    text.push_str("\n ");
    text
}

/// Suggests another variant or a rename.
fn suggest_fix(keys: &Keys, state: &StateDict, options: &ImportOptions, has_unknown: bool) -> String {
    let fitting = CliftVariant::ALL.into_iter().filter(|other| *other != options.variant).find(|other| {
        let sizes = keys.sizes(state, *other, options.num_heads);
        let options = ImportOptions { convert: true, ..options.clone() };
        sizes.config.validate().is_ok()
            && problems(keys, state, &published_tensors(&sizes.config, sizes.has_condenser), &options).is_empty()
    });
    if let Some(other) = fitting {
        return format!("\n  keys and shapes match --variant {other}");
    }
    // A rename applies to every key that contains the text.
    let first = keys.strays.keys().next().and_then(|name| name.split('.').next());
    if let Some(first) = first.filter(|first| !keys.network.values().any(|key| key.contains(first))) {
        let first = printable(first);
        return format!(
            "\n  --rename {first}=transformer.{first} assigns these keys to the network, --rename {first}=other.{first} \
             ignores them"
        );
    }
    let lead = keys.network.values().find_map(|key| key.split_once(&format!(".{PREFIX}")).map(|(lead, _)| lead));
    if let Some(lead) = lead.filter(|_| keys.prefix.is_empty()).map(printable) {
        return format!("\n  --rename {lead}.{PREFIX}={PREFIX} gives the keys their expected names");
    }
    if has_unknown { "\n  --rename FROM=TO replaces a part of the keys listed here".into() } else { String::new() }
}

/// Lists the first number of each key.
fn layer_numbers(found: &[&Problem]) -> String {
    let first =
        |problem: &&Problem| numbers_of(&problem.key).first().map(|number| (number.len(), (*number).to_owned()));
    let numbers: BTreeSet<(usize, String)> = found.iter().filter_map(first).collect(); // shorter are smaller
    let mut listed: Vec<&str> = numbers.iter().take(MAX_NUMBERS).map(|(_, number)| number.as_str()).collect();
    if numbers.len() > MAX_NUMBERS {
        listed.push("..");
    }
    listed.join(", ")
}

fn numbers_of(key: &str) -> Vec<&str> {
    key.split('.').filter(|part| is_number(part)).collect()
}
