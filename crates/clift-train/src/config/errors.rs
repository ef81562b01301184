//! Error messages for invalid configurations: unknown keys, missing keys, wrong values.

use std::ops::Range;

use clift_core::BadConfig;
use clift_data::DataError;
use clift_model::ModelError;
use codespan_reporting::diagnostic::Diagnostic;
use serde::Serialize;
use toml::de::{DeTable, DeValue};

use crate::config::diagnostic::SourceText;
use crate::config::schema::{Sections, join, nearest, quoted_names, related_key};
use crate::error::TrainError;

/// Finds every unknown key, in the order of the text.
pub(crate) fn unknown_keys(sections: &Sections, root: &DeTable, sources: &SourceText) -> Vec<Diagnostic<usize>> {
    let (mut unknown, mut pending) = (Vec::new(), vec![(String::new(), root)]);
    while let Some((section, table)) = pending.pop() {
        // Other tables are maps with free keys, or values of a wrong type, which have a message of their own.
        let Some(keys) = sections.get(&section) else { continue };
        for (key, value) in table {
            let (name, below) = (key.get_ref().as_ref(), value.get_ref().as_table());
            if !keys.iter().any(|known| known == name) {
                let (title, label, help) = unknown_key(sections, &section, name, below.is_some());
                unknown.push((key.span().start, sources.at(key.span(), title, label).with_note(help)));
            } else if let Some(below) = below {
                pending.push((join(&section, name), below));
            }
        }
    }
    unknown.sort_by_key(|(start, _)| *start);
    unknown.into_iter().map(|(_, diagnostic)| diagnostic).collect()
}

fn unknown_key(sections: &Sections, section: &str, name: &str, is_section: bool) -> (String, String, String) {
    let owner_of = |section: &str| if section.is_empty() { "the top level".to_owned() } else { format!("[{section}]") };
    let place = if section.is_empty() { String::new() } else { format!(" in [{section}]") };
    let keys = sections[section].iter().map(String::as_str);
    let is_table = is_section && section.is_empty();
    let title = if is_table { format!("unknown section [{name}]") } else { format!("unknown key `{name}`{place}") };
    let near = nearest(name, keys.clone());
    let with_key = sections.iter().filter(|(_, keys)| keys.iter().any(|key| key == name));
    let elsewhere: Vec<String> = with_key.map(|(section, _)| owner_of(section)).collect();
    let label = match near {
        Some(near) if is_table => format!("did you mean [{near}]?"),
        Some(near) if is_section || elsewhere.is_empty() => format!("did you mean `{near}`?"),
        _ if !elsewhere.is_empty() => format!("`{name}` belongs to {}", elsewhere.join(" or ")),
        _ => related_key(name, section, sections).map_or_else(String::new, |key| format!("did you mean `{key}`?")),
    };
    (title, label, format!("help: {} has {}", owner_of(section), quoted(keys)))
}

/// Rewrites the message of the deserializer, and points at the value.
pub(crate) fn wrong_value(
    error: &serde_path_to_error::Error<toml::de::Error>,
    sources: &SourceText,
) -> Diagnostic<usize> {
    let path = Some(error.path().to_string()).filter(|path| path != ".").unwrap_or_default();
    let of_path = if path.is_empty() { String::new() } else { format!(" of `{path}`") };
    let (message, span) = (error.inner().message(), error.inner().span());

    if let Some(field) = between(message, "missing field `", "`") {
        return sources.whole(format!("the key `{}` is missing", join(&path, field)));
    }
    let Some(span) = span else { return sources.whole(message.to_owned()) };
    if let Some(variant) = between(message, "unknown variant `", "`") {
        let label = nearest(variant, quoted_names(message));
        let other = if path == "device" { "every GPU is \"wgpu\"" } else { "" };
        let label = label.map_or_else(|| other.into(), |near| format!("did you mean \"{near}\"?"));
        let allowed = quoted_names(message).map(|name| format!("\"{name}\"")).collect::<Vec<_>>().join(", ");
        let help = format!("help: it is one of {allowed}");
        return sources.at(span, format!("unknown value{of_path}"), label).with_note(help);
    }
    let wrong = message.strip_prefix("invalid type: ").or_else(|| message.strip_prefix("invalid value: "));
    let label = match wrong.and_then(|wrong| wrong.rsplit_once(", expected ")) {
        Some((got, expected)) => format!("expected {}, got {}", describe_expected(expected), describe_found(got)),
        None => message.to_owned(),
    };
    sources.at(span, format!("wrong value{of_path}"), label)
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
    let BadConfig { key, value, fix } = bad_config(error)?;
    // "data.width, data.height" are two keys.
    let keys: Vec<&str> = key.split(", ").collect();
    let set: Vec<(&str, Range<usize>)> =
        keys.iter().filter_map(|key| span_of(root, key).map(|span| (*key, span))).collect();
    let title = error.to_string();
    let mut diagnostic = match set.first() {
        Some((_, span)) => sources.at(span.clone(), title, String::new()),
        None if value == "missing" => sources.whole(title),
        None => sources.whole(title).with_note(format!("the file does not set {}", quoted(keys.iter().copied()))),
    };
    let also = dotted_keys(&fix).into_iter().filter(|key| !keys.contains(key));
    let also = also.filter_map(|key| span_of(root, key).map(|span| (key, span)));
    for (key, span) in set.into_iter().skip(1).chain(also) {
        diagnostic = diagnostic.with_label(sources.mark(span, format!("`{key}` is set here")));
    }
    Some(diagnostic)
}

fn bad_config(error: &TrainError) -> Option<BadConfig> {
    match error {
        TrainError::BadConfig(bad) | TrainError::Data(DataError::BadConfig(bad)) => Some(bad.clone()),
        TrainError::Model(ModelError::BadConfig { key, value, fix }) => Some(BadConfig::new(*key, value, fix)),
        _ => None,
    }
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

fn span_of(table: &DeTable, key: &str) -> Option<Range<usize>> {
    let (first, rest) = key.split_once('.').map_or((key, None), |(first, rest)| (first, Some(rest)));
    let value = table.get(first)?;
    match rest {
        None => Some(value.span()),
        Some(rest) => span_of(value.get_ref().as_table()?, rest),
    }
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
            format!("the number {}", number.split('`').nth(1).unwrap_or(number))
        }
        Some(("boolean", value)) => value.trim_matches('`').to_owned(),
        _ if got == "sequence" => "a list".to_owned(),
        _ if got == "map" => "a section".to_owned(),
        _ => got.to_owned(),
    }
}

fn quoted<'a>(names: impl Iterator<Item = &'a str>) -> String {
    names.map(|name| format!("`{name}`")).collect::<Vec<_>>().join(", ")
}

fn between<'a>(text: &'a str, start: &str, end: &str) -> Option<&'a str> {
    text.strip_prefix(start)?.split(end).next()
}
