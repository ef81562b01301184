//! Error messages for invalid configurations: unknown keys, missing keys, wrong values.

use std::ops::Range;

use clift_model::ModelError;
use codespan_reporting::diagnostic::Diagnostic;
use serde::Serialize;
use toml::de::{DeTable, DeValue};

use crate::config::diagnostic::SourceText;
use crate::config::schema::{Keys, nearest};
use crate::error::TrainError;

/// Finds every unknown key, in the order of the text.
pub(crate) fn unknown_keys(keys: &Keys, root: &DeTable, sources: &SourceText) -> Vec<Diagnostic<usize>> {
    let mut found = Vec::new();
    collect_unknown(keys, keys, root, "", sources, &mut found);
    found.sort_by_key(|(start, _)| *start);
    found.into_iter().map(|(_, diagnostic)| diagnostic).collect()
}

fn collect_unknown(
    all: &Keys,
    keys: &Keys,
    table: &DeTable,
    section: &str,
    sources: &SourceText,
    found: &mut Vec<(usize, Diagnostic<usize>)>,
) {
    if keys.fields.is_none() {
        return; // a map with free keys, or a value of a wrong type, which has a message of its own
    }
    for (key, value) in table {
        let (name, below) = (key.get_ref().as_ref(), value.get_ref().as_table());
        match keys.get(name) {
            Some(known) => {
                if let Some(below) = below {
                    collect_unknown(all, known, below, &join(section, name), sources, found);
                }
            }
            None => found
                .push((key.span().start, unknown_key(all, keys, name, key.span(), section, below.is_some(), sources))),
        }
    }
}

fn unknown_key(
    all: &Keys,
    keys: &Keys,
    name: &str,
    span: Range<usize>,
    section: &str,
    is_section: bool,
    sources: &SourceText,
) -> Diagnostic<usize> {
    let location = if section.is_empty() { String::new() } else { format!(" in [{section}]") };
    let title = match (is_section, section.is_empty()) {
        (true, true) => format!("unknown section [{name}]"),
        _ => format!("unknown key `{name}`{location}"),
    };
    let elsewhere: Vec<String> = all.sections_with(name).iter().map(|section| format!("[{section}]")).collect();
    let label = match keys.nearest(name) {
        Some(near) if is_section && section.is_empty() => format!("did you mean [{near}]?"),
        _ if !is_section && !elsewhere.is_empty() => format!("`{name}` belongs to {}", elsewhere.join(" or ")),
        Some(near) => format!("did you mean `{near}`?"),
        None if !elsewhere.is_empty() => format!("`{name}` belongs to {}", elsewhere.join(" or ")),
        None => String::new(),
    };
    let known = quoted(keys.names());
    let owner = if section.is_empty() { "the top level".to_owned() } else { format!("[{section}]") };
    sources.at(span, title, label).with_note(format!("help: {owner} has {known}"))
}

/// Rewrites the message of the deserializer, and points at the value.
pub(crate) fn wrong_value(error: &toml::de::Error, root: &DeTable, sources: &SourceText) -> Diagnostic<usize> {
    let message = error.message();
    let span = error.span();
    let path = span.as_ref().and_then(|span| path_at(root, span)).unwrap_or_default();
    let of_path = if path.is_empty() { String::new() } else { format!(" of `{path}`") };

    if let Some(field) = between(message, "missing field `", "`") {
        return sources.whole(format!("the key `{}` is missing", join(&path, field)));
    }
    let Some(span) = span else { return sources.whole(message.to_owned()) };
    if let Some(variant) = between(message, "unknown variant `", "`") {
        let allowed: Vec<&str> = message.split('`').skip(3).step_by(2).collect();
        let label = nearest(variant, allowed.iter().copied())
            .map_or_else(String::new, |near| format!("did you mean \"{near}\"?"));
        let allowed = allowed.iter().map(|name| format!("\"{name}\"")).collect::<Vec<_>>().join(", ");
        let help = format!("help: it is one of {allowed}");
        return sources.at(span, format!("unknown value{of_path}"), label).with_note(help);
    }
    let wrong = message.strip_prefix("invalid type: ").or_else(|| message.strip_prefix("invalid value: "));
    match wrong.and_then(|wrong| wrong.rsplit_once(", expected ")) {
        Some((got, expected)) => {
            let label = format!("expected {}, got {}", describe_expected(expected), describe_found(got));
            sources.at(span, format!("wrong value{of_path}"), label)
        }
        None => sources.at(span, format!("wrong value{of_path}"), message.to_owned()),
    }
}

/// Finds a list longer than its field: the deserializer ignores further items.
pub(crate) fn too_long<T: Serialize>(config: &T, root: &DeTable, sources: &SourceText) -> Option<Diagnostic<usize>> {
    let made = toml::Value::try_from(config).ok()?;
    find_too_long(made.as_table()?, root, "", sources)
}

fn find_too_long(
    made: &toml::Table,
    table: &DeTable,
    section: &str,
    sources: &SourceText,
) -> Option<Diagnostic<usize>> {
    table.iter().find_map(|(key, value)| {
        let name = key.get_ref().as_ref();
        let path = join(section, name);
        match (made.get(name)?, value.get_ref()) {
            (toml::Value::Table(made), DeValue::Table(below)) => find_too_long(made, below, &path, sources),
            (toml::Value::Array(made), DeValue::Array(items)) if made.len() < items.len() => {
                let label = format!("expected a list of {}, got one of {}", made.len(), items.len());
                Some(sources.at(value.span(), format!("wrong value of `{path}`"), label))
            }
            _ => None,
        }
    })
}

/// Points an error at the value of its key, and marks the other keys that the error names. `None` for an error without key.
pub(crate) fn out_of_range(error: &TrainError, root: &DeTable, sources: &SourceText) -> Option<Diagnostic<usize>> {
    let (keys, fix) = match error {
        TrainError::BadConfig { key, fix, .. } => (key.as_str(), fix.as_str()),
        TrainError::Model(ModelError::BadConfig { key, fix, .. }) => (*key, fix.as_str()),
        _ => return None,
    };
    // "data.width, data.height" are two keys.
    let keys: Vec<&str> = keys.split(", ").collect();
    let set: Vec<(&str, Range<usize>)> =
        keys.iter().filter_map(|key| span_of(root, key).map(|span| (*key, span))).collect();
    let title = error.to_string();
    let mut diagnostic = match set.first() {
        Some((_, span)) => sources.at(span.clone(), title, String::new()),
        None if matches!(error, TrainError::BadConfig { value, .. } if value == "missing") => sources.whole(title),
        None => {
            let keys = quoted(keys.iter().copied());
            sources.whole(title).with_note(format!("the file does not set {keys}"))
        }
    };
    let also = dotted_keys(fix).into_iter().filter(|key| !keys.contains(key));
    let also = also.filter_map(|key| span_of(root, key).map(|span| (key, span)));
    for (key, span) in set.into_iter().skip(1).chain(also) {
        diagnostic = diagnostic.with_label(sources.mark(span, format!("`{key}` is set here")));
    }
    Some(diagnostic)
}

fn dotted_keys(text: &str) -> Vec<&str> {
    let is_part = |c: char| c.is_ascii_alphanumeric() || "_.".contains(c);
    let mut found: Vec<&str> = Vec::new();
    for word in text.split(|c| !is_part(c)).map(|word| word.trim_end_matches('.')) {
        if word.contains('.') && !found.contains(&word) {
            found.push(word);
        }
    }
    found
}

/// Returns the span of the value of a dotted key.
fn span_of(table: &DeTable, key: &str) -> Option<Range<usize>> {
    let (first, rest) = key.split_once('.').map_or((key, None), |(first, rest)| (first, Some(rest)));
    let value = table.get(first)?;
    match rest {
        None => Some(value.span()),
        Some(rest) => span_of(value.get_ref().as_table()?, rest),
    }
}

/// Returns the dotted key whose name or value has this span.
fn path_at(table: &DeTable, span: &Range<usize>) -> Option<String> {
    table.iter().find_map(|(key, value)| {
        let name = key.get_ref().as_ref();
        if key.span() == *span || value.span() == *span || contains_span(value.get_ref(), span) {
            return Some(name.to_owned());
        }
        value.get_ref().as_table().and_then(|below| path_at(below, span)).map(|below| join(name, &below))
    })
}

fn contains_span(value: &DeValue, span: &Range<usize>) -> bool {
    value
        .as_array()
        .is_some_and(|items| items.iter().any(|item| item.span() == *span || contains_span(item.get_ref(), span)))
}

fn describe_expected(expected: &str) -> String {
    match expected {
        "usize" | "u64" | "u32" | "u16" | "u8" => "a whole number of 0 or more".to_owned(),
        "isize" | "i64" | "i32" | "i16" | "i8" => "a whole number".to_owned(),
        "f32" | "f64" => "a number".to_owned(),
        "a boolean" => "true or false".to_owned(),
        "a sequence" => "a list".to_owned(),
        "path string" => "a string".to_owned(),
        other if other.starts_with("struct ") => "a section".to_owned(),
        other => other.to_owned(),
    }
}

fn describe_found(got: &str) -> String {
    match got.split_once(' ') {
        Some(("string", text)) => format!("the string {text}"),
        Some(("integer" | "floating", number)) => {
            format!("the number {}", number.trim_start_matches("point ").trim_matches('`'))
        }
        Some(("boolean", value)) => value.trim_matches('`').to_owned(),
        _ if got == "sequence" => "a list".to_owned(),
        _ if got == "map" => "a section".to_owned(),
        _ => got.to_owned(),
    }
}

fn join(section: &str, key: &str) -> String {
    if section.is_empty() { key.to_owned() } else { format!("{section}.{key}") }
}

fn quoted<'a>(names: impl Iterator<Item = &'a str>) -> String {
    names.map(|name| format!("`{name}`")).collect::<Vec<_>>().join(", ")
}

fn between<'a>(text: &'a str, start: &str, end: &str) -> Option<&'a str> {
    text.strip_prefix(start)?.split(end).next()
}
