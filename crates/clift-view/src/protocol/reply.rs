//! Messages of the server: the length of a JSON header (u32, little-endian), the header, and the parts it lists.
//!
//! The header has a `type`: `hello` (what the server offers), `scene`, `frame`, `comparison` or `failure` (the `message` of a
//! request that failed).

use serde_json::{Value, json};

/// Returns the bytes of a message of a type with these fields.
pub fn message(kind: &str, mut header: Value, parts: &[&[u8]]) -> Vec<u8> {
    header["type"] = kind.into();
    header["parts"] = json!(parts.iter().map(|part| part.len()).collect::<Vec<_>>());
    let header = header.to_string();
    let mut bytes = (header.len() as u32).to_le_bytes().to_vec();
    bytes.extend(header.as_bytes());
    bytes.extend(parts.iter().copied().flatten());
    bytes
}
