//! The ways in which an image is made: our own, two baselines, and other systems by name.

use std::collections::BTreeSet;
use std::sync::Mutex;

use serde::{Deserialize, Deserializer, Serialize};

use crate::error::EvalError;

/// Largest number of characters of a name.
const MAX_NAME: usize = 40;

/// How a view was made.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize, strum::IntoStaticStr)]
#[serde(rename_all = "snake_case")]
#[strum(serialize_all = "snake_case")]
pub enum Method {
    /// Clusters, condensed: the method.
    Clift,
    /// The tokens nearest to the cluster centres, without the condenser.
    Kmeans,
    /// The tokens in the middle of rectangular tiles of the context views, without a condenser.
    Patch,
    /// The same behind a condenser that was trained on tiles.
    PatchClift,
    /// A random subset of all tokens.
    Random,
    /// Baseline: the nearest context view.
    NearestView,
    /// Baseline: the mean of the context views.
    MeanImage,
    /// Images of another system.
    #[serde(untagged)]
    System(MethodName),
}

impl Method {
    /// Those of this program.
    pub const OWN: [Self; 7] =
        [Self::Clift, Self::Kmeans, Self::Patch, Self::PatchClift, Self::Random, Self::NearestView, Self::MeanImage];

    /// The name in files and tables.
    pub fn name(self) -> &'static str {
        match self {
            Self::System(name) => name.as_str(),
            own => own.into(),
        }
    }
}

/// Name of another system, kept for the life of the process: there are a handful.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(transparent)]
pub struct MethodName(&'static str);

impl MethodName {
    /// Checks a name: at most 40 characters, and none of this program's variants.
    ///
    /// # Errors
    /// [`EvalError::BadSystemName`].
    pub fn new(name: &str) -> Result<Self, EvalError> {
        static NAMES: Mutex<BTreeSet<&'static str>> = Mutex::new(BTreeSet::new());
        let bad = |reason: &str| EvalError::BadSystemName { name: name.into(), reason: reason.into() };
        if name.trim().is_empty() || name.chars().count() > MAX_NAME || name.chars().any(char::is_control) {
            return Err(bad("write 1 to 40 printable characters"));
        }
        if Method::OWN.iter().any(|own| own.name() == name) {
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

    /// Returns the name.
    pub const fn as_str(self) -> &'static str {
        self.0
    }
}

// By hand: the derived form would only read text of static lifetime.
impl<'de> Deserialize<'de> for MethodName {
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
            assert!(MethodName::new(name).is_err(), "{name:?}");
        }
        let name = MethodName::new("LVSM (2 views)").unwrap();
        assert_eq!(name, MethodName::new(&String::from("LVSM (2 views)")).unwrap());
        assert_eq!(name.as_str(), "LVSM (2 views)");
    }

    #[test]
    fn a_variant_is_named_alike_in_json_and_csv() {
        let other = Method::System(MethodName::new("MVSplat").unwrap());
        for variant in Method::OWN.into_iter().chain([other]) {
            assert_eq!(serde_json::to_value(variant).unwrap(), variant.name());
            assert_eq!(serde_json::from_value::<Method>(variant.name().into()).unwrap(), variant);
        }
        assert_eq!(Method::OWN.map(Method::name)[3..6], ["patch_clift", "random", "nearest_view"]);
        assert!(serde_json::from_value::<Method>("".into()).is_err());
    }
}
