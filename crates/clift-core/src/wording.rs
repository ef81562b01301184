//! Counts and lists in messages.

/// Number of names in a message.
const MAX_NAMES_SHOWN: usize = 3;

/// Joins the first few names, with dots for the others.
pub fn first_few<S: AsRef<str>>(names: &[S]) -> String {
    let mut shown: Vec<&str> = names.iter().take(MAX_NAMES_SHOWN).map(AsRef::as_ref).collect();
    if names.len() > shown.len() {
        shown.push("..");
    }
    shown.join(", ")
}

/// Formats a count with its noun: `1 scene`, `2 scenes`.
pub fn plural(count: usize, noun: &str) -> String {
    format!("{count} {noun}{}", if count == 1 { "" } else { "s" })
}
