//! Paths that documents, comments and messages name must exist.

use std::path::Path;

use crate::support::{repository, sources};

/// Folders whose files are named in texts.
const FOLDERS: [&str; 5] = ["docs/", "scripts/", "configs/", "crates/", "data-fixtures/"];

#[test]
fn every_link_and_named_path_exists() {
    let mut texts = sources(&["crates", "tests", "docs", "scripts", "configs"], &["rs", "toml", "py", "sh", "md"]);
    for name in [".ci/run", "README.md", "Cargo.toml", "deny.toml", "clippy.toml", "typos.toml"] {
        texts.insert(name.into(), std::fs::read_to_string(repository(name)).expect(name));
    }
    let missing: Vec<String> = texts
        .iter()
        .filter(|(path, _)| !path.ends_with("links.rs"))
        .flat_map(|(path, text)| missing(path, text))
        .collect();
    assert!(missing.is_empty(), "{} paths are missing:\n{}", missing.len(), missing.join("\n"));
}

/// Paths of a text that do not exist, as `path:line: named path`.
fn missing(path: &str, text: &str) -> Vec<String> {
    let exists = |path: &Path| repository("").join(path).exists();
    let folder = Path::new(path).parent().expect("a file");
    let mut found = Vec::new();
    for (number, line) in text.lines().enumerate() {
        if path.strip_suffix(".md").is_some() {
            let links = line.split("](").skip(1).filter_map(|rest| rest.split([')', '#', ' ']).next());
            let links = links.filter(|link| !link.is_empty() && !link.contains(':'));
            found.extend(links.filter(|link| !exists(&folder.join(link))).map(|link| (number, link)));
        }
        for start in FOLDERS {
            let named = line.match_indices(start).filter_map(|(at, _)| named_path(line, at));
            found.extend(named.filter(|name| !exists(Path::new(name))).map(|name| (number, name)));
        }
    }
    found.into_iter().map(|(number, name)| format!("{path}:{}: {name}", number + 1)).collect()
}

/// The path that begins at a place of a line; `None` inside of a longer one, and for patterns.
fn named_path(line: &str, at: usize) -> Option<&str> {
    let before = line[..at].trim_end_matches("../");
    let is_inside = before.ends_with(|c: char| c.is_alphanumeric() || "_-/.".contains(c));
    let end =
        line[at..].find(|c: char| !c.is_ascii_alphanumeric() && !"_-./".contains(c)).map_or(line.len(), |end| at + end);
    let is_pattern = line[end..].starts_with(['*', '{', '<', '$', '…']);
    (!is_inside && !is_pattern).then(|| line[at..end].trim_end_matches('.'))
}
