//! The version of a JSON file.

use serde::de::DeserializeOwned;
use serde_json::Value;

/// Checks `version` of a file.
pub(crate) fn check_version(file: &Value, expected: u32) -> Result<(), String> {
    match &file["version"] {
        found if *found == expected => Ok(()),
        found => {
            Err(format!("version {found}, this clift reads version {expected}; the clift that wrote the file reads it"))
        }
    }
}

/// Parses a file of a version.
pub(crate) fn parse_versioned<T: DeserializeOwned>(text: &[u8], version: u32) -> Result<T, String> {
    let value: Value = serde_json::from_slice(text).map_err(|error| error.to_string())?;
    check_version(&value, version)?;
    serde_json::from_value(value).map_err(|error| error.to_string())
}
