//! Parsers of argument values.

use std::path::PathBuf;
use std::str::FromStr;

use clift_data::Split;
use clift_train::{RunStep, Stage};

pub(crate) fn parse_split(text: &str) -> Result<Split, String> {
    let splits = [Split::Train, Split::Test];
    splits.into_iter().find(|split| split.to_string() == text).ok_or_else(|| "write train or test".into())
}

pub(crate) fn parse_training_step(text: &str) -> Result<RunStep, String> {
    let steps = [Stage::Stage1.into(), RunStep::Clusters, Stage::Stage2.into()];
    let found = steps.into_iter().find(|step: &RunStep| step.name() == text);
    found.ok_or_else(|| "write stage1, clusters or stage2".into())
}

pub(crate) fn parse_count(text: &str) -> Result<usize, String> {
    parse_number(text, |count| *count > 0, "write a number of at least 1")
}

/// Parses the path of a file or folder to read.
pub(crate) fn parse_input(text: &str) -> Result<PathBuf, String> {
    let path = PathBuf::from(text);
    if path.exists() { Ok(path) } else { Err("no such file or folder".into()) }
}

/// Parses the directory of a run.
pub(crate) fn parse_run(text: &str) -> Result<PathBuf, String> {
    let path = PathBuf::from(text);
    match (path.exists(), path.join("config.toml").is_file()) {
        (true, true) => Ok(path),
        (true, false) => Err("that is no run: it has no config.toml; write the `run_dir` of a `clift train`".into()),
        (false, _) => Err("no such folder; write the `run_dir` of a `clift train`".into()),
    }
}

/// Parses the path of a file to write, before the work whose results it takes.
pub(crate) fn parse_output(text: &str) -> Result<PathBuf, String> {
    let path = PathBuf::from(text);
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
    match folder.filter(|folder| !folder.is_dir()) {
        Some(folder) => Err(format!("no folder {}; create it first", folder.display())),
        None if path.is_dir() => Err("that is a folder; write the name of a file in it".into()),
        None => Ok(path),
    }
}

/// Parses `[width, height]` in pixels, as `64x48`.
pub(crate) fn parse_size(text: &str) -> Result<[usize; 2], String> {
    let size = parse_pair(text, "x").or_else(|| parse_pair(text, "X"));
    size.filter(|size| !size.contains(&0)).ok_or_else(|| "write width and height in pixels, e.g. 64x48".into())
}

/// Parses fewest and most frames, as `45..135`.
pub(crate) fn parse_distance(text: &str) -> Result<[usize; 2], String> {
    parse_pair(text, "..").ok_or_else(|| "write fewest and most frames, e.g. 45..135".into())
}

/// Parses how many photos one is left out of: 0 for none, or at least 2.
pub(crate) fn parse_hold_out(text: &str) -> Result<usize, String> {
    parse_number(text, |count| *count != 1, "write 2 or more, such as 8, or 0 for none")
}

fn parse_number<T: FromStr>(text: &str, is_valid: impl Fn(&T) -> bool, fix: &str) -> Result<T, String> {
    text.parse().ok().filter(is_valid).ok_or_else(|| fix.into())
}

fn parse_pair(text: &str, separator: &str) -> Option<[usize; 2]> {
    let (first, second) = text.split_once(separator)?;
    Some([first.parse().ok()?, second.parse().ok()?])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_are_parsed_or_refused() {
        assert_eq!((parse_size("64x48"), parse_distance("6..20")), (Ok([64, 48]), Ok([6, 20])));
        let refused = [parse_size("64"), parse_size("0x4"), parse_size("4x"), parse_distance("6")];
        assert!(refused.iter().all(Result::is_err) && parse_count("0").is_err(), "{refused:?}");
        assert_eq!(parse_output("x.json"), Ok("x.json".into()));
        for (path, word) in [(".", "is a folder"), ("no/such/x.json", "no folder no/such")] {
            assert!(parse_output(path).unwrap_err().contains(word), "{path}");
        }
        assert!(parse_input(".").is_ok() && parse_input("no/such").is_err());
        assert!([".", "no/such"].iter().all(|path| parse_run(path).unwrap_err().contains("write the `run_dir`")));
    }
}
