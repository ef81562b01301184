//! Arguments that several commands share.

use std::path::{Path, PathBuf};

use clift_model::DeviceName;
use clift_train::{Config, TrainError, parse_config, read_checked_config};
use serde::Serialize;

use crate::commands::args::parse::parse_output;
use crate::output::output_file::OutputFile;
use crate::output::stdout::{print_note, print_result};

macro_rules! shipped_configs {
    ($($name:literal)*) => {
        &[$((concat!("configs/", $name), include_str!(concat!("../../../../../configs/", $name)))),*]
    };
}

/// Configs inside the program, by the paths that they have in the repository.
const CONFIGS: &[(&str, &str)] = shipped_configs![
    "capture.toml" "dl3dv.toml" "lvsm-ed-re10k.toml" "lvsm-ed-synthetic.toml" "lvsm-ed-tiny.toml" "re10k-small.toml"
    "re10k.toml" "rooms-128.toml" "rooms-64.toml" "rooms.toml" "synthetic.toml" "tiny.toml"
];

/// Options that override keys of a config.
#[derive(Debug, clap::Args)]
pub struct ConfigArgs {
    /// Override a key of the config, e.g. `stage1.steps=100`; repeatable
    ///
    /// The value is TOML; a word or a path of letters, digits and -_./\:~+@% needs no quotes. Others are quoted twice:
    /// `--set 'data.root="my photos"'`, in the prompt of Windows `--set "data.root='C:\my photos'"`.
    #[arg(long, value_name = "KEY=TOML")]
    pub set: Vec<String>,
    /// Select the device: flex, ndarray or wgpu [default: `device` of the config]
    #[arg(long, value_name = "DEVICE")]
    pub device: Option<DeviceName>,
}

impl ConfigArgs {
    /// Reads a config with these overrides and checks its values.
    pub fn read(&self, path: &Path, check: impl FnOnce(&Config) -> Result<(), TrainError>) -> anyhow::Result<Config> {
        let (mut config, _) = read_config(path, &self.set, check)?;
        config.device = self.device.unwrap_or(config.device);
        Ok(config)
    }

    /// Whether `--set` gives a key, even with the value of the config.
    pub fn sets(&self, section: &str, key: &str) -> bool {
        let mut tables = self.set.iter().filter_map(|text| text.parse::<toml::Table>().ok());
        tables.any(|table| table.get(section).is_some_and(|section| section.get(key).is_some()))
    }
}

/// Reads a config, applies the overrides of `--set` and checks the values. Returns also the keys that were set. Where a path
/// of [`CONFIGS`] does not exist, the config inside the program is read.
pub fn read_config(
    path: &Path,
    set: &[String],
    check: impl FnOnce(&Config) -> Result<(), TrainError>,
) -> anyhow::Result<(Config, Vec<String>)> {
    let shipped = || CONFIGS.iter().find(|(name, _)| path == Path::new(name) && !path.exists());
    Ok(match shipped() {
        Some((_, text)) => {
            print_note(&format!("config: {}, which ships with clift", path.display()));
            parse_config(path, text, set, check)?
        }
        None => read_checked_config(path, set, check)?,
    })
}

#[derive(Debug, clap::Args)]
pub struct JsonArg {
    /// Write the results as JSON
    // Another id than the field's, which arguments with this one flattened may have themselves.
    #[arg(id = "json", long, value_name = "FILE", value_parser = parse_output)]
    pub path: Option<PathBuf>,
    /// Replace existing files
    #[arg(long)]
    pub force: bool,
}

impl JsonArg {
    /// Checks the file, if one is given, before the work on `inputs`.
    pub fn open(&self, inputs: &[&Path]) -> anyhow::Result<JsonFile> {
        let file = self.path.as_ref().map(|path| OutputFile::new(path, self.force, inputs));
        Ok(JsonFile(file.transpose()?))
    }

    /// Checks the file before work on a config, whose files are inputs, too; so is the run that the config belongs to.
    pub fn open_for(&self, path: &Path, config: &Config) -> anyhow::Result<JsonFile> {
        let run = path.parent().filter(|folder| folder.join("run.json").exists());
        let files = config.input_paths();
        let inputs: Vec<&Path> = [path].into_iter().chain(run).chain(files.iter().map(PathBuf::as_path)).collect();
        self.open(&inputs)
    }
}

/// The file of `--json`, if one is given.
pub struct JsonFile(Option<OutputFile>);

impl JsonFile {
    /// Writes the file and prints its path.
    pub fn write(&self, results: &impl Serialize) -> anyhow::Result<()> {
        let Some(file) = &self.0 else { return Ok(()) };
        file.write_json(results)?;
        print_result(&format!("results: {}", file.path().display()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_program_contains_every_config() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs");
        let mut names: Vec<String> = std::fs::read_dir(folder)
            .unwrap()
            .map(|item| format!("configs/{}", item.unwrap().file_name().to_string_lossy()))
            .collect();
        names.sort();
        assert!(CONFIGS.iter().map(|(name, _)| name).eq(&names), "{names:?} are in the repository");
    }
}
