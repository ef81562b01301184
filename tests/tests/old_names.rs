//! Replaced type names, which no source may contain.

use std::collections::BTreeSet;

use crate::architecture::{Sources, without_strings};
use crate::support::sources;

const OLD_NAMES: &str = "Accumulator Adaptive Attended BadInstructionSet BadStep BoundedSampler CheckpointTensor \
    ClusterJob Disjoint Drawn Exhibit Extended FrameSkip GeluSlope GroupsOnce HalfRow HeldOut HostViews Imported InF64 Judge LayoutOptions \
    Learner Ledger PictureFolders Projected ReadOnce RendererOnly SceneFrame SceneMemory SystemName TokenChoice \
    TokenStorage Trained Unfinished WorldFrame WrongUsage";

#[test]
fn replaced_names_are_gone() {
    let found = old_names(&sources(&["crates", "tests/src", "tests/tests"], &["rs"]));
    assert!(found.is_empty(), "{} old names:\n{}", found.len(), found.join("\n"));
}

/// Old names in code, as `path:line: name`.
fn old_names(sources: &Sources) -> Vec<String> {
    let names: BTreeSet<&str> = OLD_NAMES.split_whitespace().collect();
    let others = sources.iter().filter(|(path, _)| !path.ends_with("old_names.rs"));
    let lines = others.flat_map(|(path, text)| text.lines().enumerate().map(move |(i, line)| (path, i, line)));
    let words = lines.flat_map(|(path, i, line)| {
        let code = without_strings(line);
        let words = code.split(|c: char| !c.is_alphanumeric() && c != '_');
        let found = words.filter(|word| names.contains(word)).map(|word| format!("{path}:{}: {word}", i + 1));
        found.collect::<Vec<_>>()
    });
    words.collect()
}

#[test]
fn old_names_are_found_in_code_alone() {
    let text = "// The Ledger.\nlet text = \"Ledger\";\nlet ledger = Ledger::default();\n";
    assert_eq!(old_names(&Sources::from([("a.rs".to_owned(), text.to_owned())])), ["a.rs:3: Ledger"]);
}
