//! `--set key=TOML`: parses overrides and merges them into the table of the file.

use std::borrow::Cow;

use codespan_reporting::diagnostic::Diagnostic;
use toml::Spanned;
use toml::de::{DeTable, DeValue};

use crate::config::diagnostic::SourceText;

/// Parts of a dotted key, and the value.
type KeyValue<'t> = (Vec<Spanned<String>>, Spanned<DeValue<'t>>);

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

/// Inserts a value.
///
/// # Errors
/// The part of the key that is a value instead of a section.
pub(crate) fn merge_value<'t>(
    base: &mut DeTable<'t>,
    key: &[Spanned<String>],
    value: Spanned<DeValue<'t>>,
) -> Result<(), Spanned<String>> {
    let Some((first, rest)) = key.split_first() else { return Ok(()) };
    let name = Spanned::new(first.span(), Cow::Owned(first.get_ref().clone()));
    if rest.is_empty() {
        base.remove(first.get_ref().as_str());
        base.insert(name, value);
        return Ok(());
    }
    let section = base.entry(name).or_insert_with(|| Spanned::new(first.span(), DeValue::Table(DeTable::new())));
    match section.get_mut() {
        DeValue::Table(section) => merge_value(section, rest, value),
        _ => Err(first.clone()),
    }
}

pub(crate) fn dotted(key: &[Spanned<String>]) -> String {
    key.iter().map(|part| part.get_ref().as_str()).collect::<Vec<_>>().join(".")
}
