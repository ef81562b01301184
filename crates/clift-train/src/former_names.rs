//! Former names of keys and values: a configuration that has them is read, with a note.
//!
//! Aliases of serde would be listed among the known keys and values.

use toml::Spanned;
use toml::de::{DeTable, DeValue};

use crate::keys::Keys;
use crate::overrides::Override;

/// Keys of the top level: the former name and the present one.
const KEYS: [(&str, &str); 1] = [("recompute", "activation_checkpointing")];

/// Values: section, key, the former name and the present one.
const VALUES: [(&str, &str, &str, &str); 1] = [("clusters", "grouping", "patch", "tile")];

/// Gives every key and value of a configuration its present name. Returns what was renamed.
///
/// A former key beside its successor stays, and is refused as unknown.
pub(crate) fn rename(root: &mut DeTable, keys: &Keys) -> Vec<Override> {
    let mut renamed = Vec::new();
    for (old, new) in KEYS {
        if keys.get(new).is_none() || root.contains_key(new) {
            continue;
        }
        if let Some((key, value)) = root.remove_entry(old) {
            root.insert(Spanned::new(key.span(), new.into()), value);
            renamed.push(Override::renamed(old.to_owned(), new.to_owned()));
        }
    }
    for (section, key, old, new) in VALUES {
        let Some(DeValue::Table(table)) = root.get_mut(section).map(Spanned::get_mut) else { continue };
        if let Some(DeValue::String(text)) = table.get_mut(key).map(Spanned::get_mut)
            && text == old
        {
            *text = new.into();
            renamed.push(Override::renamed(
                format!("{section}.{key} = \"{old}\""),
                format!("{section}.{key} = \"{new}\""),
            ));
        }
    }
    renamed
}
