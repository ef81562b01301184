//! Reads a configuration: a TOML file, then `--set key=TOML` overrides. Errors show the line with the mistake.

use std::path::{Path, PathBuf};

use serde::Serialize;
use serde::de::DeserializeOwned;
use toml::Spanned;
use toml::de::DeTable;

use crate::config::config::Config;
use crate::config::diagnostic::SourceText;
use crate::config::errors;
use crate::config::former_names::apply_former_names;
use crate::config::overrides::{Override, dotted, merge_value, parse_override, to_toml};
use crate::config::schema::Keys;
use crate::error::TrainError;

/// Errors of a configuration.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ConfigError {
    /// The file could not be read.
    #[error("reading the configuration failed: {source}: {path}", path = path.display())]
    Io {
        /// Error of the operating system.
        source: std::io::Error,
        /// The file.
        path: PathBuf,
    },
    /// A mistake in the file or an override, shown with its line: no TOML, an unknown or missing key, or a wrong value.
    #[error("{0}")]
    Invalid(String),
    /// Another error of the values.
    #[error(transparent)]
    Other(Box<TrainError>),
}

/// Reads the TOML file at `path`, applies the overrides in order, and returns the config with the changed keys.
///
/// An override is `key=TOML` with a dotted key: `stage1.steps=100`, `clusters.grid=[0.5, 1.0]`. A word of
/// letters, digits and `-_./\:~+@%` that is no TOML value is a string: `device=wgpu` and `data.root=/data/re10k` need no
/// inner quotes.
///
/// # Errors
/// [`ConfigError`]; its message shows the line and the fix.
pub fn read_config<T: DeserializeOwned + Serialize>(
    path: &Path,
    overrides: &[String],
) -> Result<(T, Vec<Override>), ConfigError> {
    parse_config(path, &read(path)?, overrides)
}

/// Does [`read_config`] on a text; `path` is only used in messages.
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

/// Does [`read_config`] for a whole experiment, then calls `check` on the config.
///
/// # Errors
/// As [`read_config`], and [`ConfigError::Invalid`] with the line of the key that `check` refuses.
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
    changed.extend(apply_former_names(root.get_mut(), &keys));
    let unknown = errors::unknown_keys(&keys, root.get_ref(), &sources);
    if !unknown.is_empty() {
        let all: Vec<_> = unknown.iter().map(|diagnostic| sources.render(diagnostic)).collect();
        return Err(ConfigError::Invalid(all.join("\n\n")));
    }
    let invalid = |diagnostic| ConfigError::Invalid(sources.render(&diagnostic));
    let config = T::deserialize(toml::Deserializer::from(root.clone()))
        .map_err(|error| invalid(errors::wrong_value(&error, root.get_ref(), &sources)))?;
    if let Some(diagnostic) = errors::too_long(&config, root.get_ref(), &sources) {
        return Err(invalid(diagnostic));
    }
    check(&config).map_err(|error| match errors::out_of_range(&error, root.get_ref(), &sources) {
        Some(diagnostic) => invalid(diagnostic),
        None => ConfigError::Other(Box::new(error)),
    })?;
    Ok((config, changed))
}

/// Parses the file, merges the overrides into its table, and lists the changed keys.
fn merged<'t>(
    sources: &SourceText,
    file: &'t str,
    padded: &'t [String],
) -> Result<(Spanned<DeTable<'t>>, Vec<Override>), ConfigError> {
    let invalid = |diagnostic: &_| ConfigError::Invalid(sources.render(diagnostic));
    let mut root = DeTable::parse(file).map_err(|error| {
        invalid(&sources.at(error.span().unwrap_or(0..0), "the file is not TOML".into(), error.message().into()))
    })?;
    let mut changed: Vec<Override> = Vec::new();
    for (index, text) in padded.iter().enumerate() {
        let start = sources.override_start(index);
        let (key, value) = parse_override(sources, text, start).map_err(|diagnostic| invalid(&diagnostic))?;
        let to = to_toml(value.get_ref());
        let from = merge_value(root.get_mut(), &key, value).map_err(|blocked| {
            let title = format!("`{}` is a value, not a section", blocked.get_ref());
            invalid(&sources.at(blocked.span(), title, "cannot hold a key".into()))
        })?;
        let key = dotted(&key);
        match changed.iter_mut().find(|change| change.key == key) {
            Some(change) => change.to = to,
            None => changed.push(Override { key, from: from.as_ref().map(to_toml), to, is_renamed: false }),
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
    fn overrides_replace_values_and_changes_are_listed() {
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
    fn overrides_supply_missing_keys_and_need_no_quotes() {
        assert_eq!(parse("", &["model.num_heads=2"]).unwrap().0.model.num_heads, 2);
        for (text, expected) in [("device=/data/re10k-v2.1", "/data/re10k-v2.1"), ("device=\"a b\"", "a b")] {
            assert_eq!(parse(FILE, &[text]).unwrap().0.device, expected);
        }
        assert!(message(FILE, &["device="]).starts_with("the value of `device` is not TOML"));
    }

    #[test]
    fn every_unknown_key_is_listed_with_a_suggestion() {
        let expected = "unknown key `batch_size` in [model]
  --> tiny.toml:3:1
  |
3 | batch_size = 4
  | ^^^^^^^^^^ `batch_size` belongs to [stage1]
  |
  = help: [model] has `num_heads`

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
    fn override_errors_point_into_the_override() {
        for (text, title, position) in [
            ("stage1.step=100", "unknown key `step` in [stage1]", "--set:1:8"),
            ("stage1.steps=1O0", "wrong value of `stage1.steps`", "--set:1:14"),
            ("clusters.range=[0]", "wrong value of `clusters.range`", "--set:1:16"),
            ("clusters.range=[0, 1, 2]", "wrong value of `clusters.range`", "--set:1:16"),
            ("device=a b", "the value of `device` is not TOML", "--set:1:8"),
            ("stage1.steps.x=1", "`steps` is a value, not a section", "--set:1:8"),
        ] {
            let message = message(FILE, &["device=wgpu", text]);
            assert!(message.starts_with(&format!("{title}\n  --> {position}\n")), "{message}");
        }
    }

    #[test]
    fn missing_keys_and_files_are_named() {
        assert_eq!(message("[model]\n", &[]), "the key `model.num_heads` is missing\n = in tiny.toml");
        assert_eq!(message("", &[]), "the key `model` is missing\n = in tiny.toml");
        let error = read_config::<Config>(Path::new("no/such.toml"), &[]).unwrap_err().to_string();
        assert!(error.starts_with("reading the configuration failed: "), "{error}");
        assert!(error.ends_with(": no/such.toml"), "{error}");
    }
}
