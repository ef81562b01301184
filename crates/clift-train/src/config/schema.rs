//! Sections of a configuration type with their keys, and the key nearest to a misspelled one.

use std::collections::BTreeMap;

use serde::de::DeserializeOwned;
use toml::{Table, Value};

/// Keys of every section in the order of the type, by the dotted path of the section; the top level is the empty path.
pub(crate) type Sections = BTreeMap<String, Vec<String>>;

/// Returns the sections of `T`. Writes an unknown key into each: the refusal of serde lists the known ones.
pub(crate) fn sections<T: DeserializeOwned>() -> Sections {
    let (mut sections, mut pending) = (Sections::new(), vec![String::new()]);
    while let Some(section) = pending.pop() {
        let unknown = Table::from_iter([("?".to_owned(), Value::Integer(0))]);
        let parts = section.rsplit('.').filter(|part| !part.is_empty());
        let table = parts.fold(unknown, |table, part| Table::from_iter([(part.to_owned(), Value::Table(table))]));
        let Err(error) = T::deserialize(table) else { continue };
        if error.message().starts_with("unknown field `?`") {
            let keys: Vec<String> = quoted_names(error.message()).map(str::to_owned).collect();
            pending.extend(keys.iter().map(|key| join(&section, key)));
            sections.insert(section, keys);
        }
    }
    sections
}

/// Returns the names that serde expects instead of an unknown one: all in backquotes but the first.
pub(crate) fn quoted_names(message: &str) -> impl Iterator<Item = &str> {
    message.split('`').skip(3).step_by(2)
}

/// Returns the candidate with the smallest edit distance, if that is at most a third of the word.
pub(crate) fn nearest<'a>(word: &str, candidates: impl Iterator<Item = &'a str>) -> Option<&'a str> {
    candidates
        .map(|candidate| (strsim::damerau_levenshtein(word, candidate), candidate))
        .filter(|(distance, candidate)| *distance <= (word.len().max(candidate.len()) / 3).max(1))
        .min_by_key(|(distance, _)| *distance)
        .map(|(_, candidate)| candidate)
}

/// Returns the dotted key that another name may mean: one with the name as its initials, else one that shares a word. Keys of
/// `section` come first, then those of the sections below it.
pub(crate) fn related_key(name: &str, section: &str, sections: &Sections) -> Option<String> {
    let words = |name: &str| -> Vec<String> {
        name.split('_').filter(|word| !["", "min", "max", "num"].contains(word)).map(str::to_owned).collect()
    };
    let wanted = words(name);
    let has_initials = |key: &str| key.split('_').filter_map(|word| word.chars().next()).eq(name.chars());
    let shares_word = |key: &str| words(key).iter().any(|word| wanted.contains(word));
    let near = |other: &str| (other != section, !other.starts_with(section));
    let mut keys: Vec<(&str, &str)> =
        sections.iter().flat_map(|(section, keys)| keys.iter().map(|key| (section.as_str(), key.as_str()))).collect();
    keys.sort_by_key(|(section, _)| near(section));
    let found =
        keys.iter().find(|(_, key)| has_initials(key)).or_else(|| keys.iter().find(|(_, key)| shares_word(key)));
    found.map(|(section, key)| join(section, key))
}

pub(crate) fn join(section: &str, key: &str) -> String {
    if section.is_empty() { key.to_owned() } else { format!("{section}.{key}") }
}
