//! Former names of keys and values, which are read with a note. (Aliases of serde would be listed as known keys.)

use toml::Spanned;
use toml::de::{DeTable, DeValue};

use crate::config::overrides::Override;
use crate::config::schema::Keys;

/// Keys of the top level: former and present name.
const KEYS: [(&str, &str); 1] = [("recompute", "activation_checkpointing")];
/// Values: section, key, former and present name.
const VALUES: [(&str, &str, &str, &str); 1] = [("clusters", "grouping", "patch", "tile")];

/// Replaces former names of keys and values, and returns the changes. A former key beside the present one is kept, and
/// refused as unknown.
pub(crate) fn apply_former_names(root: &mut DeTable, keys: &Keys) -> Vec<Override> {
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
