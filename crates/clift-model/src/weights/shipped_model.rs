//! The model that ships with clift, which the program contains.

use std::borrow::Cow;
use std::path::{Path, PathBuf};

use clift_core::{make_folder, replace_file};
use sha2::{Digest, Sha256};

use crate::error::ModelError;

/// Folder of the shipped model in the repository. Where no such folder exists, this path names the model inside the program: on
/// the command line, in `init_from` of a config and in scene files.
pub const SHIPPED_MODEL: &str = "models/rooms";

const FILES: [(&str, &[u8]); 3] = [
    ("codec.safetensors", include_bytes!("../../../../models/rooms/codec.safetensors")),
    ("config.toml", include_bytes!("../../../../models/rooms/config.toml")),
    ("model.safetensors", include_bytes!("../../../../models/rooms/model.safetensors")),
];

/// Whether a path names the model inside the program.
pub fn is_shipped(path: &Path) -> bool {
    path == Path::new(SHIPPED_MODEL) && !path.exists()
}

/// Returns a path that exists for one that [names the model inside the program](is_shipped): its files are written to the data
/// folder of the user, unless they are there. Returns every other path as it is.
pub fn find_shipped(path: &Path) -> Result<Cow<'_, Path>, ModelError> {
    if is_shipped(path) { unpack(&data_folder()).map(Cow::Owned) } else { Ok(Cow::Borrowed(path)) }
}

/// Returns the user's data folder; the current folder for a user without home.
fn data_folder() -> PathBuf {
    let set = |name| std::env::var_os(name).filter(|value| !value.is_empty()).map(PathBuf::from);
    let home = || std::env::home_dir().unwrap_or_default().join(".local/share");
    set("XDG_DATA_HOME").or_else(|| set("LOCALAPPDATA")).unwrap_or_else(home)
}

/// Writes the files below `data`, to a folder with their hash in its name: other versions of clift have other models.
fn unpack(data: &Path) -> Result<PathBuf, ModelError> {
    let hash = FILES.iter().fold(Sha256::new(), |hash, (_, bytes)| hash.chain_update(bytes)).finalize();
    let folder = data.join("clift").join(format!("rooms-{}", hex::encode(&hash[..4])));
    let write = || {
        make_folder(&folder)?;
        for (name, bytes) in FILES {
            let path = folder.join(name);
            if !std::fs::read(&path).is_ok_and(|found| found == bytes) {
                replace_file(&path, bytes)?;
            }
        }
        Ok(())
    };
    write().map_err(|source| ModelError::NotUnpacked { source, path: folder.clone() })?;
    Ok(folder)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::weights::model_path::ModelPath;

    #[test]
    fn the_model_is_unpacked_once_and_mended() {
        let data = tempfile::tempdir().unwrap();
        let folder = unpack(data.path()).unwrap();
        assert!(ModelPath::find(&folder).unwrap().config().unwrap().dim > 0);
        let weights = folder.join("model.safetensors");
        std::fs::write(&weights, "cut").unwrap();
        assert_eq!(unpack(data.path()).unwrap(), folder);
        assert_eq!(std::fs::read(&weights).unwrap(), FILES[2].1);
        let written = || std::fs::metadata(&weights).unwrap().modified().unwrap();
        let before = written();
        unpack(data.path()).unwrap();
        assert_eq!(written(), before);
        let message = unpack(&weights).unwrap_err().to_string();
        assert!(message.contains("set XDG_DATA_HOME to a folder that can be written"), "{message}");
    }

    #[test]
    fn other_paths_are_returned() {
        for path in ["models/other", "models", "/models/rooms"] {
            assert_eq!(find_shipped(Path::new(path)).unwrap(), Path::new(path));
        }
        assert!(is_shipped(Path::new("models/rooms/")));
    }
}
