//! Names of rendering methods that other programs implement.

use std::collections::BTreeSet;
use std::sync::Mutex;

use serde::{Deserialize, Deserializer, Serialize};

use crate::EvalError;

/// Most characters of a name.
const MAX_NAME: usize = 40;

/// Names of our own variants, and of the baselines.
const TAKEN: [&str; 7] = ["clift", "kmeans", "patch", "patch_clift", "random", "nearest_view", "mean_image"];

/// Name of a system, kept for the life of the process: there are a handful.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(transparent)]
pub struct SystemName(&'static str);

impl SystemName {
    /// Takes a name of at most 40 characters that is not one of our own variants'.
    ///
    /// # Errors
    /// [`EvalError::BadSystemName`].
    pub fn new(name: &str) -> Result<Self, EvalError> {
        static NAMES: Mutex<BTreeSet<&'static str>> = Mutex::new(BTreeSet::new());
        let bad = |reason: &str| EvalError::BadSystemName { name: name.into(), reason: reason.into() };
        if name.trim().is_empty() || name.chars().count() > MAX_NAME || name.chars().any(char::is_control) {
            return Err(bad("write 1 to 40 printable characters"));
        }
        if TAKEN.contains(&name) {
            return Err(bad("a variant of this program has that name"));
        }
        let mut names = NAMES.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        if let Some(known) = names.get(name) {
            return Ok(Self(known));
        }
        let kept: &'static str = Box::leak(name.to_owned().into_boxed_str());
        names.insert(kept);
        Ok(Self(kept))
    }

    /// The name.
    pub const fn as_str(self) -> &'static str {
        self.0
    }
}

// By hand: the derived form would only read what lives for ever.
impl<'de> Deserialize<'de> for SystemName {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        Self::new(&String::deserialize(deserializer)?).map_err(serde::de::Error::custom)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_printable_and_not_our_own() {
        for name in ["", " ", "clift", "kmeans", "a\nb", &"x".repeat(41)] {
            assert!(SystemName::new(name).is_err(), "{name:?}");
        }
        let name = SystemName::new("LVSM (2 views)").unwrap();
        assert_eq!(name, SystemName::new(&String::from("LVSM (2 views)")).unwrap());
        assert_eq!(name.as_str(), "LVSM (2 views)");
    }
}
