//! Token selection settings.

use std::fmt;
use std::str::FromStr;

use clift_model::{ModelError, SelectionPreset};
use serde::{Deserialize, Serialize};

/// Selection of the rendered tokens of a view, for fewer tokens than stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum Selection {
    /// A published preset of Algorithm 1.
    Preset(SelectionPreset),
    /// Random tokens for every view: a baseline of the presets.
    Random,
}

impl Default for Selection {
    fn default() -> Self {
        Self::Preset(SelectionPreset::default())
    }
}

impl fmt::Display for Selection {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Preset(preset) => preset.name(),
            Self::Random => "random",
        })
    }
}

impl FromStr for Selection {
    type Err = ModelError;

    fn from_str(name: &str) -> Result<Self, ModelError> {
        if name == "random" {
            return Ok(Self::Random);
        }
        let preset = SelectionPreset::ALL.into_iter().find(|preset| preset.name() == name);
        preset.map(Self::Preset).ok_or_else(|| ModelError::BadConfig {
            key: "selection",
            value: name.into(),
            fix: format!("write one of {}, random", SelectionPreset::ALL.map(SelectionPreset::name).join(", ")),
        })
    }
}

impl TryFrom<String> for Selection {
    type Error = ModelError;

    fn try_from(name: String) -> Result<Self, ModelError> {
        name.parse()
    }
}

impl From<Selection> for String {
    fn from(selection: Selection) -> Self {
        selection.to_string()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn selections_are_names() {
        for name in ["paper", "global", "scaled", "random"] {
            let selection: Selection = serde_json::from_str(&format!("\"{name}\"")).unwrap();
            assert_eq!((selection.to_string(), name.parse::<Selection>().unwrap()), (name.to_owned(), selection));
            assert_eq!(serde_json::to_value(selection).unwrap(), name);
        }
        let message = "all".parse::<Selection>().unwrap_err().to_string();
        assert!(message.contains("paper, global, scaled, random"), "{message}");
    }
}
