//! Scene keys: the hashes and the prefix of DL3DV, and keys that are paths.

/// Prefix of the keys of DL3DV training scenes in the chunks of DepthSplat.
pub(crate) const DL3DV_PREFIX: &str = "dl3dv_";
/// Number of digits of the hashes that name DL3DV scenes.
const HASH_LENGTH: usize = 64;

/// Returns whether a key is a hash, as of DL3DV scenes.
pub fn is_dl3dv_key(key: &str) -> bool {
    let name = last_name(key);
    name.len() == HASH_LENGTH && name.bytes().all(|byte| byte.is_ascii_hexdigit())
}

pub(crate) fn last_name(key: &str) -> &str {
    key.rsplit('/').next().unwrap_or_default()
}

/// Returns the scene whose key is a path that ends in `name`, if unique; of copies of a DL3DV scene the first.
pub(crate) fn find_by_name<'a>(keys: impl Iterator<Item = &'a str>, name: &str) -> Option<usize> {
    let mut found = keys.enumerate().filter(|(_, key)| key.contains('/') && last_name(key) == name);
    let (first, _) = found.next()?;
    (found.next().is_none() || is_dl3dv_key(name)).then_some(first)
}

/// Returns a key without the prefix of DepthSplat; for DL3DV scenes, the hash without its path.
pub(crate) fn plain_key(key: &str) -> &str {
    let name = last_name(key);
    let name = name.strip_prefix(DL3DV_PREFIX).unwrap_or(name);
    if is_dl3dv_key(name) { name } else { key.strip_prefix(DL3DV_PREFIX).unwrap_or(key) }
}
