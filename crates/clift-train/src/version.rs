//! The version of a JSON file.

use serde_json::Value;

/// Checks `version` of a file.
///
/// # Errors
/// The version that was found and the one that is read.
pub(crate) fn check_version(file: &Value, expected: u32) -> Result<(), String> {
    match &file["version"] {
        found if *found == expected => Ok(()),
        found => {
            Err(format!("version {found}, this clift reads version {expected}; the clift that wrote the file reads it"))
        }
    }
}
