//! Sources and licences of dependencies, by `deny.toml`: `cargo deny check licenses sources` without the tool, for the
//! dependencies of this build; cargo-deny checks every target and feature.

use std::collections::{BTreeMap, BTreeSet};
use std::process::Command;

use crate::support::repository;

#[test]
fn every_dependency_comes_from_crates_io() {
    let lock = std::fs::read_to_string(repository("Cargo.lock")).expect("the lock file is checked in");
    let sources: Vec<&str> = lock.lines().filter(|line| line.starts_with("source = ")).collect();
    assert!(sources.len() > 100, "the lock file has dependencies");
    let foreign: Vec<_> = sources
        .iter()
        .filter(|line| !line.contains("\"registry+https://github.com/rust-lang/crates.io-index\""))
        .collect();
    assert!(foreign.is_empty(), "{foreign:?}");
}

#[test]
fn every_licence_is_allowed() {
    let (allowed, exceptions) = allowed();
    assert!(allowed.iter().any(|licence| licence == "MIT"), "{allowed:?}");
    let output = Command::new(env!("CARGO"))
        .args(["tree", "--workspace", "--locked", "--offline", "--edges", "normal,build,dev", "--prefix", "none"])
        .args(["--no-dedupe", "--format", "{p}|{l}"])
        .current_dir(repository("."))
        .output()
        .expect("cargo runs");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let text = String::from_utf8(output.stdout).expect("cargo prints UTF-8");
    let packages: BTreeSet<(&str, &str)> = text.lines().filter_map(|line| line.split_once('|')).collect();
    assert!(packages.len() > 100, "{text}");
    let refused: Vec<String> = packages
        .iter()
        .filter_map(|(package, licence)| {
            let name = package.split(' ').next().unwrap_or_default();
            let is_allowed = |one: &str| {
                allowed.iter().any(|a| a == one) || exceptions.get(name).is_some_and(|list| list.contains(one))
            };
            (!holds(licence, &is_allowed)).then(|| format!("{package}: {licence:?}"))
        })
        .collect();
    assert!(refused.is_empty(), "{refused:?}");
}

/// The allowed licences of `deny.toml`, and the exceptions by crate.
fn allowed() -> (Vec<String>, BTreeMap<String, String>) {
    let text = std::fs::read_to_string(repository("deny.toml")).expect("deny.toml is checked in");
    let quoted = |line: &str| line.split('"').nth(1).map(str::to_owned);
    let list = text.split("allow = [").nth(1).expect("it allows licences").lines().skip(1);
    let allowed = list.take_while(|line| !line.starts_with(']')).filter_map(quoted).collect();
    let exceptions = text.lines().filter(|line| line.trim_start().starts_with("{ crate = "));
    (allowed, exceptions.filter_map(|line| Some((quoted(line)?, line.to_owned()))).collect())
}

/// Returns whether an SPDX expression is satisfied: one side of every OR, both sides of every AND.
fn holds(expression: &str, is_allowed: &dyn Fn(&str) -> bool) -> bool {
    let expression = expression.trim();
    let outer = |word: &str| {
        let mut depth = 0;
        expression.char_indices().find_map(|(at, c)| {
            depth += i32::from(c == '(') - i32::from(c == ')');
            (depth == 0 && expression[at..].starts_with(word)).then_some(at)
        })
    };
    for (word, both) in [(" OR ", false), ("/", false), (" AND ", true)] {
        if let Some(at) = outer(word) {
            let sides = [&expression[..at], &expression[at + word.len()..]].map(|side| holds(side, is_allowed));
            return if both { sides[0] && sides[1] } else { sides[0] || sides[1] };
        }
    }
    match expression.strip_prefix('(').and_then(|inner| inner.strip_suffix(')')) {
        Some(inner) => holds(inner, is_allowed),
        None => is_allowed(expression),
    }
}

#[test]
fn expressions_are_read_as_they_are_meant() {
    let kept = |expression: &str| holds(expression, &|one| ["MIT", "Zlib", "A WITH b"].contains(&one));
    assert!(kept("MIT") && kept("GPL OR MIT") && kept("Apache-2.0/MIT") && kept("A WITH b AND Zlib"));
    assert!(kept("(GPL OR MIT) AND Zlib") && kept("GPL AND X OR MIT"));
    assert!(!kept("GPL") && !kept("MIT AND GPL") && !kept("") && !kept("(GPL OR X) AND MIT"));
}
