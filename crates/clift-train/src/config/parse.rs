//! Reads a configuration: a TOML file, then `--set key=TOML` overrides. Errors show the line with the mistake.

use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use serde::Serialize;
use serde::de::DeserializeOwned;
use toml::Spanned;
use toml::de::DeTable;

use crate::config::diagnostic::SourceText;
use crate::config::errors;
use crate::config::overrides::{dotted, merge_value, parse_override};
use crate::config::schema::sections;
use crate::error::TrainError;

const MAX_BYTES: u64 = 1 << 20;

/// Errors of a configuration.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
#[expect(missing_docs, reason = "the message of a variant says what its fields are")]
pub enum ConfigError {
    #[error("reading the configuration failed: {source}: {path}", path = path.display())]
    Io { source: std::io::Error, path: PathBuf },
    /// A mistake in the file or an override, shown with its line: no TOML, an unknown or missing key, or a wrong value.
    #[error("{0}")]
    Invalid(String),
    #[error(transparent)]
    Other(Box<TrainError>),
}

/// Reads the TOML file at `path`, applies the overrides in order, and returns the config with the dotted keys of the overrides.
///
/// An override is `key=TOML` with a dotted key: `stage1.steps=100`, `clusters.grid=[0.5, 1.0]`. A word of
/// letters, digits and `-_./\:~+@%` that is not a TOML value is a string: `device=wgpu` and `data.root=/data/re10k` need no
/// inner quotes.
pub fn read_config<T: DeserializeOwned + Serialize>(
    path: &Path,
    overrides: &[String],
) -> Result<(T, Vec<String>), ConfigError> {
    read_checked_config(path, overrides, |_| Ok(()))
}

/// Does [`read_config`], then calls `check` on the config.
pub fn read_checked_config<T: DeserializeOwned + Serialize>(
    path: &Path,
    overrides: &[String],
    check: impl FnOnce(&T) -> Result<(), TrainError>,
) -> Result<(T, Vec<String>), ConfigError> {
    let file = read_text(path).map_err(|source| ConfigError::Io { source, path: path.to_owned() })?;
    parse_config(path, &file, overrides, check)
}

/// Reads a file of at most [`MAX_BYTES`]; devices have no end.
fn read_text(path: &Path) -> std::io::Result<String> {
    let mut text = String::new();
    if File::open(path)?.take(MAX_BYTES + 1).read_to_string(&mut text)? as u64 > MAX_BYTES {
        return Err(std::io::Error::other(format!("the file has more than {MAX_BYTES} bytes and is not a config")));
    }
    Ok(text)
}

/// Does [`read_checked_config`] on a text; `path` is only used in messages.
pub fn parse_config<T: DeserializeOwned + Serialize>(
    path: &Path,
    file: &str,
    overrides: &[String],
    check: impl FnOnce(&T) -> Result<(), TrainError>,
) -> Result<(T, Vec<String>), ConfigError> {
    let sources = SourceText::new(path, file, overrides);
    let padded = sources.padded_overrides();
    let (root, set_keys) = merged(&sources, file, &padded)?;
    let unknown = errors::unknown_keys(&sections::<T>(), root.get_ref(), &sources);
    if !unknown.is_empty() {
        let all: Vec<_> = unknown.iter().map(|diagnostic| sources.render(diagnostic)).collect();
        return Err(ConfigError::Invalid(all.join("\n\n")));
    }
    let invalid = |diagnostic| ConfigError::Invalid(sources.render(&diagnostic));
    let config: T = serde_path_to_error::deserialize(toml::Deserializer::from(root.clone()))
        .map_err(|error| invalid(errors::wrong_value(&error, &sources)))?;
    if let Some(diagnostic) = errors::too_long(&config, root.get_ref(), &sources) {
        return Err(invalid(diagnostic));
    }
    check(&config).map_err(|error| match errors::out_of_range(&error, root.get_ref(), &sources) {
        Some(diagnostic) => invalid(diagnostic),
        None => ConfigError::Other(Box::new(error)),
    })?;
    Ok((config, set_keys))
}

fn merged<'t>(
    sources: &SourceText,
    file: &'t str,
    padded: &'t [(usize, String)],
) -> Result<(Spanned<DeTable<'t>>, Vec<String>), ConfigError> {
    let invalid = |diagnostic: &_| ConfigError::Invalid(sources.render(diagnostic));
    let mut root = DeTable::parse(file).map_err(|error| {
        invalid(&sources.at(error.span().unwrap_or(0..0), "the file is not TOML".into(), error.message().into()))
    })?;
    let mut set_keys = Vec::new();
    for (start, text) in padded {
        let (key, value) = parse_override(sources, text, *start).map_err(|diagnostic| invalid(&diagnostic))?;
        merge_value(root.get_mut(), &key, value).map_err(|blocked| {
            let title = format!("`{}` is a value, not a section", blocked.get_ref());
            invalid(&sources.at(blocked.span(), title, "cannot hold a key".into()))
        })?;
        set_keys.push(dotted(&key));
    }
    Ok((root, set_keys))
}

// The suite compares whole messages with `tests/snapshots`.
#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::config::Config;

    const FILE: &str = "[data]\n[stage1]\nsteps = 90000\n[stage2]\n[cluster]\n";

    #[cfg(unix)]
    #[test]
    fn devices_are_not_configs() {
        let message = read_config::<Config>(Path::new("/dev/zero"), &[]).unwrap_err().to_string();
        assert!(message.contains("more than 1048576 bytes and is not a config: /dev/zero"), "{message}");
    }

    #[test]
    fn every_mistake_is_listed_in_its_text() {
        let overrides = ["device=wgpu", "stage2.step=3"].map(str::to_owned);
        let parsed = parse_config::<Config>(Path::new("tiny.toml"), FILE, &overrides, |_| Ok(()));
        let message = parsed.unwrap_err().to_string();
        let titles: Vec<&str> = message.split("\n\n").filter_map(|part| part.split("\n  |").next()).collect();
        assert_eq!(
            titles,
            ["unknown section [cluster]\n  --> tiny.toml:5:2", "unknown key `step` in [stage2]\n  --> --set:1:8"]
        );
    }
}
