//! Keys of scenes: DL3DV's hashes and prefix, keys that are paths.

/// Prefix of the keys of DL3DV's training scenes in DepthSplat's chunks.
pub(crate) const DL3DV_PREFIX: &str = "dl3dv_";
/// Digits of the hashes that DL3DV's scenes are named after.
const HASH_LENGTH: usize = 64;

/// Returns whether a scene is named after a hash, as DL3DV's are.
pub fn is_dl3dv_key(key: &str) -> bool {
    let name = last_name(key);
    name.len() == HASH_LENGTH && name.bytes().all(|byte| byte.is_ascii_hexdigit())
}

/// Returns the last part of a key that is a path.
pub(crate) fn last_name(key: &str) -> &str {
    key.rsplit('/').next().unwrap_or_default()
}

/// Returns the scene whose key is a path that ends in `name`: the only one, or the first of DL3DV's copies of a scene.
pub(crate) fn find_by_name<'a>(keys: impl Iterator<Item = &'a str>, name: &str) -> Option<usize> {
    let mut found = keys.enumerate().filter(|(_, key)| key.contains('/') && last_name(key) == name);
    let (first, _) = found.next()?;
    (found.next().is_none() || is_dl3dv_key(name)).then_some(first)
}

/// Returns a key without DepthSplat's prefix; of DL3DV's keys the hash alone, wherever a copy of the scene lies.
pub(crate) fn plain_key(key: &str) -> &str {
    let name = last_name(key);
    let name = name.strip_prefix(DL3DV_PREFIX).unwrap_or(name);
    if is_dl3dv_key(name) { name } else { key.strip_prefix(DL3DV_PREFIX).unwrap_or(key) }
}
