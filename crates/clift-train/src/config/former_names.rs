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

#[cfg(test)]
mod tests {
    use std::path::Path;

    use clift_model::Grouping;

    use crate::config::config::Config;
    use crate::config::overrides::Override;
    use crate::config::parse::{ConfigError, parse_config};

    const LEAST: &str = "run_dir = \"run\"\n[data]\n[stage1]\n[stage2]\n[clusters]\n";

    fn parse(file: &str, overrides: &[&str]) -> Result<(Config, Vec<Override>), ConfigError> {
        let overrides: Vec<String> = overrides.iter().map(|&text| text.to_owned()).collect();
        parse_config(Path::new("a.toml"), file, &overrides)
    }

    #[test]
    fn former_names_are_read_with_a_note() {
        let file = format!("recompute = true\n{LEAST}grouping = \"patch\"\n");
        for (file, overrides) in [(file.as_str(), &[][..]), (LEAST, &["recompute=true", "clusters.grouping=patch"][..])]
        {
            let (config, changed) = parse(file, overrides).unwrap();
            assert!(config.activation_checkpointing && config.clusters.grouping == Grouping::Tile);
            let notes: Vec<_> = changed.iter().skip(overrides.len()).map(ToString::to_string).collect();
            assert_eq!(
                notes,
                [
                    "`recompute` is named `activation_checkpointing` now",
                    "`clusters.grouping = \"patch\"` is named `clusters.grouping = \"tile\"` now"
                ]
            );
            let written = toml::to_string(&config).unwrap();
            assert!(written.contains("activation_checkpointing = true\n") && !written.contains("recompute"));
            assert!(written.contains("grouping = \"tile\"\n") && !written.contains("\"patch\""));
        }
    }

    #[test]
    fn former_key_beside_the_present_one_is_refused() {
        let message = parse(LEAST, &["recompute=true", "activation_checkpointing=false"]).unwrap_err().to_string();
        assert!(message.starts_with("unknown key `recompute`"), "{message}");
        assert!(message.contains("`activation_checkpointing`"), "{message}");
    }
}
