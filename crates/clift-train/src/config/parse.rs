//! Reads a configuration: a TOML file, then `--set key=TOML` overrides, with every mistake shown in place.

use std::path::{Path, PathBuf};

use serde::Serialize;
use serde::de::DeserializeOwned;
use toml::Spanned;
use toml::de::DeTable;

use crate::config::config::Config;
use crate::config::diagnostic::SourceText;
use crate::config::errors;
use crate::config::former_names::rename;
use crate::config::overrides::{Override, dotted, merge, parse_override, show};
use crate::config::schema::Keys;
use crate::error::TrainError;

/// Why a configuration was refused.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ConfigError {
    /// The file could not be read.
    #[error("reading the configuration failed: {source}: {path}", path = path.display())]
    Io {
        /// The operating system's reason.
        source: std::io::Error,
        /// The file.
        path: PathBuf,
    },
    /// The file is not TOML.
    #[error("{0}")]
    Syntax(String),
    /// A `--set` is not `key=TOML`, or goes below a key that is no section.
    #[error("{0}")]
    Override(String),
    /// Keys that the configuration does not have, all of them.
    #[error("{0}")]
    UnknownKeys(String),
    /// A key is missing, or its value has the wrong type or is not one of those allowed.
    #[error("{0}")]
    Value(String),
    /// A value is out of its range, or does not fit another one.
    #[error("{0}")]
    Range(String),
    /// Something else is wrong with the values.
    #[error(transparent)]
    Other(Box<TrainError>),
}

/// Reads the TOML file at `path`, applies the overrides in order, and lists what they changed.
///
/// An override is `key=TOML` with a dotted key: `stage1.steps=100`, `clusters.grid=[0.5, 1.0]`. A word of
/// letters, digits and `-_./\:~+@%` that is no TOML value is a string, so that `device=wgpu` and
/// `data.root=/data/re10k` need no second pair of quotes; where a number is expected, its type is then wrong.
///
/// # Errors
/// [`ConfigError`]; its message shows the line, a caret and the fix.
pub fn read_config<T: DeserializeOwned + Serialize>(
    path: &Path,
    overrides: &[String],
) -> Result<(T, Vec<Override>), ConfigError> {
    parse_config(path, &read(path)?, overrides)
}

/// Does [`read_config`] on text that is in memory; `path` is only named in messages.
///
/// # Errors
/// As [`read_config`].
pub fn parse_config<T: DeserializeOwned + Serialize>(
    path: &Path,
    file: &str,
    overrides: &[String],
) -> Result<(T, Vec<Override>), ConfigError> {
    parse_checked(path, file, overrides, |_| Ok(()))
}

/// Does [`read_config`] for a whole experiment, and then asks `check` whether its values fit.
///
/// # Errors
/// As [`read_config`], and [`ConfigError::Range`] with the place of a value that `check` refuses by its key.
pub fn read_checked_config(
    path: &Path,
    overrides: &[String],
    check: impl FnOnce(&Config) -> Result<(), TrainError>,
) -> Result<(Config, Vec<Override>), ConfigError> {
    parse_checked(path, &read(path)?, overrides, check)
}

fn read(path: &Path) -> Result<String, ConfigError> {
    std::fs::read_to_string(path).map_err(|source| ConfigError::Io { source, path: path.to_owned() })
}

fn parse_checked<T: DeserializeOwned + Serialize>(
    path: &Path,
    file: &str,
    overrides: &[String],
    check: impl FnOnce(&T) -> Result<(), TrainError>,
) -> Result<(T, Vec<Override>), ConfigError> {
    let sources = SourceText::new(path, file, overrides);
    let padded = sources.padded_overrides();
    let keys = Keys::of::<T>();
    let (mut root, mut changed) = merged(&sources, file, &padded)?;
    changed.extend(rename(root.get_mut(), &keys));
    let unknown = errors::unknown_keys(&keys, root.get_ref(), &sources);
    if !unknown.is_empty() {
        let all: Vec<_> = unknown.iter().map(|diagnostic| sources.render(diagnostic)).collect();
        return Err(ConfigError::UnknownKeys(all.join("\n\n")));
    }
    let value = |diagnostic| ConfigError::Value(sources.render(&diagnostic));
    let config = T::deserialize(toml::Deserializer::from(root.clone()))
        .map_err(|error| value(errors::wrong_value(&error, root.get_ref(), &sources)))?;
    if let Some(diagnostic) = errors::too_long(&config, root.get_ref(), &sources) {
        return Err(value(diagnostic));
    }
    check(&config).map_err(|error| match errors::out_of_range(&error, root.get_ref(), &sources) {
        Some(diagnostic) => ConfigError::Range(sources.render(&diagnostic)),
        None => ConfigError::Other(Box::new(error)),
    })?;
    Ok((config, changed))
}

/// The file's table with the overrides in it, and what those changed.
fn merged<'t>(
    sources: &SourceText,
    file: &'t str,
    padded: &'t [String],
) -> Result<(Spanned<DeTable<'t>>, Vec<Override>), ConfigError> {
    let mut root = DeTable::parse(file).map_err(|error| {
        let span = error.span().unwrap_or(0..0);
        let diagnostic = sources.at(span, "the file is not TOML".into(), error.message().into());
        ConfigError::Syntax(sources.render(&diagnostic))
    })?;
    let refused = |diagnostic: &_| ConfigError::Override(sources.render(diagnostic));
    let mut changed: Vec<Override> = Vec::new();
    for (index, text) in padded.iter().enumerate() {
        let start = sources.override_start(index);
        let (key, value) = parse_override(sources, text, start).map_err(|diagnostic| refused(&diagnostic))?;
        let to = show(value.get_ref());
        let from = merge(root.get_mut(), &key, value).map_err(|blocked| {
            let title = format!("`{}` is a value, not a section", blocked.get_ref());
            refused(&sources.at(blocked.span(), title, "cannot hold a key".into()))
        })?;
        let key = dotted(&key);
        match changed.iter_mut().find(|change| change.key == key) {
            Some(change) => change.to = to,
            None => changed.push(Override { key, from: from.as_ref().map(show), to, is_renamed: false }),
        }
    }
    changed.retain(|change| change.from.as_ref() != Some(&change.to));
    Ok((root, changed))
}

#[cfg(test)]
mod tests {
    use serde::{Deserialize, Serialize};

    use super::*;

    #[derive(Debug, PartialEq, Deserialize, Serialize)]
    #[serde(deny_unknown_fields)]
    struct Config {
        #[serde(default)]
        device: String,
        model: Model,
        #[serde(default)]
        stage1: Stage,
        #[serde(default)]
        clusters: Clusters,
    }

    #[derive(Debug, PartialEq, Deserialize, Serialize)]
    #[serde(deny_unknown_fields)]
    struct Model {
        num_heads: usize,
        #[serde(default)]
        norm: Norm,
    }

    #[derive(Debug, Default, PartialEq, Deserialize, Serialize)]
    #[serde(rename_all = "lowercase")]
    enum Norm {
        #[default]
        Layer,
        Rms,
    }

    #[derive(Debug, Default, PartialEq, Deserialize, Serialize)]
    #[serde(default, deny_unknown_fields)]
    struct Stage {
        steps: usize,
        lr: f64,
        batch_size: usize,
    }

    #[derive(Debug, Default, PartialEq, Deserialize, Serialize)]
    #[serde(default, deny_unknown_fields)]
    struct Clusters {
        grid: Vec<f64>,
        range: [f64; 2],
    }

    const FILE: &str = "# tiny\n[model]\nnum_heads = 4\n\n[stage1]\nsteps = 90000\n";

    fn parse(file: &str, overrides: &[&str]) -> Result<(Config, Vec<Override>), ConfigError> {
        let overrides: Vec<String> = overrides.iter().map(|&text| text.to_owned()).collect();
        parse_config(Path::new("tiny.toml"), file, &overrides)
    }

    fn message(file: &str, overrides: &[&str]) -> String {
        parse(file, overrides).unwrap_err().to_string()
    }

    #[test]
    fn overrides_win_over_the_file_and_what_differs_is_listed() {
        let overrides = [
            "stage1.steps=100",
            "stage1.steps = 30",
            "clusters.grid=[0.5, 1]",
            "device=wgpu",
            "model.num_heads=4",
            "stage1.lr=3e-4",
        ];
        let (config, changed) = parse(FILE, &overrides).unwrap();
        assert_eq!((config.stage1.steps, config.stage1.lr), (30, 3e-4));
        assert_eq!((config.device.as_str(), config.clusters.grid.as_slice()), ("wgpu", &[0.5, 1.0][..]));
        let shown: Vec<String> = changed.iter().map(ToString::to_string).collect();
        let expected = [
            "--set stage1.steps: 90000 -> 30",
            "--set clusters.grid: (default) -> [0.5, 1]",
            "--set device: (default) -> \"wgpu\"",
            "--set stage1.lr: (default) -> 3e-4",
        ];
        assert_eq!(shown, expected);
    }

    #[test]
    fn an_override_may_supply_what_the_file_lacks() {
        assert_eq!(parse("", &["model.num_heads=2"]).unwrap().0.model.num_heads, 2);
    }

    #[test]
    fn a_path_needs_no_quotes_and_a_quoted_string_is_taken_as_it_is() {
        for (text, expected) in [("device=/data/re10k-v2.1", "/data/re10k-v2.1"), ("device=\"a b\"", "a b")] {
            assert_eq!(parse(FILE, &[text]).unwrap().0.device, expected);
        }
        assert!(message(FILE, &["device="]).starts_with("the value of `device` is not TOML"));
    }

    #[test]
    fn an_unknown_key_is_shown_with_the_nearest_one() {
        let expected = "unknown key `num_head` in [model]
  --> tiny.toml:2:1
  |
2 | num_head = 4
  | ^^^^^^^^ did you mean `num_heads`?
  |
  = help: [model] has `num_heads`, `norm`";
        assert_eq!(message("[model]\nnum_head = 4\n", &[]), expected);
    }

    #[test]
    fn every_unknown_key_is_shown_and_one_of_another_section_is_sent_there() {
        let expected = "unknown key `batch_size` in [model]
  --> tiny.toml:3:1
  |
3 | batch_size = 4
  | ^^^^^^^^^^ `batch_size` belongs to [stage1]
  |
  = help: [model] has `num_heads`, `norm`

unknown section [stage2]
  --> tiny.toml:4:2
  |
4 | [stage2]
  |  ^^^^^^ did you mean [stage1]?
  |
  = help: the top level has `device`, `model`, `stage1`, `clusters`";
        assert_eq!(message("[model]\nnum_heads = 4\nbatch_size = 4\n[stage2]\n", &[]), expected);
    }

    #[test]
    fn an_unknown_key_of_an_override_is_shown_in_the_override() {
        let expected = "unknown key `step` in [stage1]
  --> --set:1:8
  |
1 | stage1.step=100
  |        ^^^^ did you mean `steps`?
  |
  = help: [stage1] has `steps`, `lr`, `batch_size`";
        assert_eq!(message(FILE, &["device=wgpu", "stage1.step=100"]), expected);
    }

    #[test]
    fn a_wrong_type_says_what_was_expected_and_what_stands_there() {
        let expected = "wrong value of `stage1.steps`
  --> tiny.toml:4:9
  |
4 | steps = \"100\"
  |         ^^^^^ expected a whole number of 0 or more, got the string \"100\"";
        assert_eq!(message("[model]\nnum_heads = 4\n[stage1]\nsteps = \"100\"\n", &[]), expected);

        let expected = "wrong value of `stage1.steps`
  --> --set:1:14
  |
1 | stage1.steps=1O0
  |              ^^^ expected a whole number of 0 or more, got the string \"1O0\"";
        assert_eq!(message(FILE, &["stage1.steps=1O0"]), expected);

        let expected = "wrong value of `clusters.grid`
  --> --set:1:21
  |
1 | clusters.grid=[0.5, true]
  |                     ^^^^ expected a number, got true";
        assert_eq!(message(FILE, &["clusters.grid=[0.5, true]"]), expected);
    }

    #[test]
    fn a_list_that_is_too_long_is_not_cut() {
        let expected = "wrong value of `clusters.range`
  --> --set:1:16
  |
1 | clusters.range=[0, 1, 2]
  |                ^^^^^^^^^ expected a list of 2, got one of 3";
        assert_eq!(message(FILE, &["clusters.range=[0, 1, 2]"]), expected);
        assert!(message(FILE, &["clusters.range=[0]"]).starts_with("wrong value of `clusters.range`"));
    }

    #[test]
    fn a_negative_count_is_refused() {
        let expected = "wrong value of `stage1.steps`
  --> --set:1:14
  |
1 | stage1.steps=-3
  |              ^^ expected a whole number of 0 or more, got the number -3";
        assert_eq!(message(FILE, &["stage1.steps=-3"]), expected);
    }

    #[test]
    fn an_unknown_choice_is_shown_with_the_allowed_ones() {
        let expected = "unknown value of `model.norm`
  --> tiny.toml:3:8
  |
3 | norm = \"rsm\"
  |        ^^^^^ did you mean \"rms\"?
  |
  = help: it is one of \"layer\", \"rms\"";
        assert_eq!(message("[model]\nnum_heads = 4\nnorm = \"rsm\"\n", &[]), expected);
    }

    #[test]
    fn a_missing_key_is_named_with_its_section() {
        assert_eq!(message("[model]\n", &[]), "the key `model.num_heads` is missing\n = in tiny.toml");
        assert_eq!(message("", &[]), "the key `model` is missing\n = in tiny.toml");
    }

    #[test]
    fn a_file_that_is_not_toml_is_shown_where_it_breaks() {
        let expected = "the file is not TOML
  --> tiny.toml:2:13
  |
2 | num_heads = eight
  |             ^^^^^ string values must be quoted, expected literal string";
        assert_eq!(message("[model]\nnum_heads = eight\n", &[]), expected);
    }

    #[test]
    fn an_override_that_is_no_toml_shows_how_to_write_it() {
        let expected = "the value of `device` is not TOML
  --> --set:1:8
  |
1 | device=a b
  |        ^^^ string values must be quoted, expected literal string
  |
  = help: a string is written --set 'device=\"a b\"', a list --set 'device=[1, 2]'";
        assert_eq!(message(FILE, &["device=a b"]), expected);

        let expected = "an override is not `key=value` on one line
  --> --set:1:1
  |
1 | stage1.steps
  | ^^^^^^^^^^^^
  |
  = help: for example --set stage1.steps=100";
        assert_eq!(message(FILE, &["stage1.steps"]), expected);
    }

    #[test]
    fn an_override_cannot_go_below_a_value() {
        let expected = "`steps` is a value, not a section
  --> --set:1:8
  |
1 | stage1.steps.x=1
  |        ^^^^^ cannot hold a key";
        assert_eq!(message(FILE, &["stage1.steps.x=1"]), expected);
    }

    #[test]
    fn a_missing_file_is_named_last() {
        let error = read_config::<Config>(Path::new("no/such.toml"), &[]).unwrap_err().to_string();
        assert!(error.starts_with("reading the configuration failed: "), "{error}");
        assert!(error.ends_with(": no/such.toml"), "{error}");
    }
}
