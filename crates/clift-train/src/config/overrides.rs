//! `--set key=TOML`: parses overrides and merges them into the table of the file.

use std::borrow::Cow;
use std::fmt;

use codespan_reporting::diagnostic::Diagnostic;
use toml::Spanned;
use toml::de::{DeTable, DeValue};

use crate::config::diagnostic::SourceText;

/// Change of a key by `--set`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Override {
    /// Dotted key.
    pub key: String,
    /// Value of the file as TOML; `None` if the file does not set the key.
    pub from: Option<String>,
    /// New value as TOML.
    pub to: String,
}

impl fmt::Display for Override {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { key, from, to } = self;
        write!(f, "--set {key}: {} -> {to}", from.as_deref().unwrap_or("(default)"))
    }
}

/// Parts of a dotted key, and the value.
type KeyValue<'t> = (Vec<Spanned<String>>, Spanned<DeValue<'t>>);

/// Splits `key=TOML` into the key's parts and the value.
pub(crate) fn parse_override<'t>(
    sources: &SourceText,
    text: &'t str,
    start: usize,
) -> Result<KeyValue<'t>, Box<Diagnostic<usize>>> {
    let Some(equals) = text.find('=').filter(|_| !text.contains(['\n', '\r'])) else {
        let title = "an override is not `key=value` on one line".to_owned();
        let diagnostic = sources.at(start..text.len(), title, String::new());
        return Err(Box::new(diagnostic.with_note("help: for example --set stage1.steps=100")));
    };
    let key_only = format!("{}=0", &text[..equals]);
    let (key, _) =
        DeTable::parse(&key_only).map(|table| split_key(table.into_inner(), usize::MAX)).map_err(|error| {
            sources.at(start..equals, "an override's key is not a dotted key".into(), error.message().into())
        })?;

    let error = match DeTable::parse(text) {
        Ok(table) => return Ok(split_key(table.into_inner(), key.len())),
        Err(error) => error,
    };
    let word = text[equals + 1..].trim();
    let word_start = text.len() - text[equals + 1..].trim_start().len();
    let is_word = |c: char| c.is_alphanumeric() || "-_./\\:~+@%".contains(c);
    if !word.is_empty() && word.chars().all(is_word) {
        let string = DeValue::String(Cow::Borrowed(word));
        return Ok((key, Spanned::new(word_start..word_start + word.len(), string)));
    }
    let key = dotted(&key);
    let title = format!("the value of `{key}` is not TOML");
    let diagnostic = sources.at(word_start..text.len(), title, error.message().into());
    let unquoted = word.trim_matches(['"', '\'']);
    let help = format!("help: a string is written --set '{key}=\"{unquoted}\"', a list --set '{key}=[1, 2]'");
    Err(Box::new(diagnostic.with_note(help)))
}

/// Follows the only key of a table down to the value, at most `depth` keys deep.
fn split_key(table: DeTable, depth: usize) -> KeyValue {
    let mut value = Spanned::new(0..0, DeValue::Table(table));
    let mut key = Vec::new();
    while key.len() < depth {
        match value.into_inner() {
            DeValue::Table(table) if !table.is_empty() => {
                let (part, below) = table.into_iter().next().expect("a table with a key");
                key.push(Spanned::new(part.span(), part.into_inner().into_owned()));
                value = below;
            }
            other => {
                value = Spanned::new(0..0, other);
                break;
            }
        }
    }
    (key, value)
}

/// Inserts a value and returns the former one.
///
/// # Errors
/// The part of the key that is a value instead of a section.
pub(crate) fn merge_value<'t>(
    base: &mut DeTable<'t>,
    key: &[Spanned<String>],
    value: Spanned<DeValue<'t>>,
) -> Result<Option<DeValue<'t>>, Spanned<String>> {
    let Some((first, rest)) = key.split_first() else { return Ok(None) };
    let name = || Spanned::new(first.span(), Cow::Owned(first.get_ref().clone()));
    if rest.is_empty() {
        let old = base.remove(first.get_ref().as_str());
        base.insert(name(), value);
        return Ok(old.map(Spanned::into_inner));
    }
    if !base.contains_key(first.get_ref().as_str()) {
        base.insert(name(), Spanned::new(first.span(), DeValue::Table(DeTable::new())));
    }
    match base.get_mut(first.get_ref().as_str()).map(Spanned::get_mut) {
        Some(DeValue::Table(section)) => merge_value(section, rest, value),
        _ => Err(first.clone()),
    }
}

pub(crate) fn dotted(key: &[Spanned<String>]) -> String {
    key.iter().map(|part| part.get_ref().as_str()).collect::<Vec<_>>().join(".")
}

/// Writes a value as TOML on one line.
pub(crate) fn to_toml(value: &DeValue) -> String {
    let list = |items: Vec<String>| items.join(", ");
    match value {
        DeValue::String(text) => toml::Value::String(text.to_string()).to_string(),
        DeValue::Integer(integer) => integer.to_string(),
        DeValue::Float(float) => float.as_str().to_owned(),
        DeValue::Boolean(boolean) => boolean.to_string(),
        DeValue::Datetime(datetime) => datetime.to_string(),
        DeValue::Array(items) => format!("[{}]", list(items.iter().map(|item| to_toml(item.get_ref())).collect())),
        DeValue::Table(table) => {
            let entries = table.iter().map(|(key, value)| format!("{} = {}", key.get_ref(), to_toml(value.get_ref())));
            format!("{{ {} }}", list(entries.collect()))
        }
    }
}
