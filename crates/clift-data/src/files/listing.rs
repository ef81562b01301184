//! File names of a folder, and their natural order.

use std::cmp::Ordering;
use std::ffi::OsString;
use std::path::Path;

use unicode_normalization::UnicodeNormalization;

use crate::error::DataError;

const MAX_ENTRIES: usize = 1_000_000;

/// Returns the names of the entries of a folder, sorted. Names that begin with a dot are hidden files, such as the
/// `._0.png` that macOS writes beside every copied `0.png`; they and names that are not UTF-8 are left out.
pub(crate) fn file_names(folder: &Path) -> Result<Vec<String>, DataError> {
    Ok(raw_file_names(folder)?.into_iter().filter_map(|name| name.into_string().ok()).collect())
}

/// Returns the names of the entries of a folder as [`file_names`], with names that are not UTF-8.
pub(crate) fn raw_file_names(folder: &Path) -> Result<Vec<OsString>, DataError> {
    let mut names = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(DataError::io("listing the folder", folder))? {
        let name = entry.map_err(DataError::io("listing the folder", folder))?.file_name();
        names.extend(Some(name).filter(|name| !name.as_encoded_bytes().starts_with(b".")));
        if names.len() > MAX_ENTRIES {
            let what = format!("the folder has more than {MAX_ENTRIES} entries");
            return Err(DataError::UnknownLayout { what, path: folder.to_owned() });
        }
    }
    names.sort_unstable();
    Ok(names)
}

/// Decodes a name as UTF-8, or else as Latin-1, and composes its characters: macOS writes an umlaut as a letter and a mark.
pub(crate) fn decode_name(bytes: &[u8]) -> String {
    let latin = || bytes.iter().copied().map(char::from).collect();
    str::from_utf8(bytes).map_or_else(|_| latin(), |name| name.nfc().collect())
}

/// Returns whether a name has the extension `ending`, case-sensitive.
pub(crate) fn has_ending(name: &str, ending: &str) -> bool {
    name.strip_suffix(ending).is_some_and(|stem| stem.ends_with('.'))
}

/// Compares names in natural order: `frame_2` before `frame_10`. Only equal names compare equal.
pub(crate) fn natural_order(a: &str, b: &str) -> Ordering {
    let (mut left, mut right) = (a.as_bytes(), b.as_bytes());
    while let (Some(&x), Some(&y)) = (left.first(), right.first()) {
        let order = if x.is_ascii_digit() && y.is_ascii_digit() {
            let (x, y) = (take_number(&mut left), take_number(&mut right));
            x.len().cmp(&y.len()).then_with(|| x.cmp(y))
        } else {
            (left, right) = (&left[1..], &right[1..]);
            x.cmp(&y)
        };
        if order.is_ne() {
            return order;
        }
    }
    left.len().cmp(&right.len()).then_with(|| a.cmp(b))
}

/// Splits off the leading digits; returns them without leading zeros.
fn take_number<'a>(text: &mut &'a [u8]) -> &'a [u8] {
    let end = text.iter().position(|byte| !byte.is_ascii_digit()).unwrap_or(text.len());
    let (digits, rest) = text.split_at(end);
    *text = rest;
    &digits[digits.iter().take_while(|digit| **digit == b'0').count()..]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn natural_order_compares_numbers_by_value() {
        let mut names = ["b1", "frame_10.png", "frame_2.png", "frame_002.png", "frame_1a.png", "a", "10", "9", ""];
        names.sort_unstable_by(|a, b| natural_order(a, b));
        let sorted = ["", "9", "10", "a", "b1", "frame_1a.png", "frame_002.png", "frame_2.png", "frame_10.png"];
        assert_eq!(names, sorted);
    }
}
