//! Rendering methods: own methods, two baselines, and external methods by name.

use std::str::FromStr;

use arrayvec::ArrayString;
use clift_model::{Architecture, Grouping};
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use crate::error::EvalError;

const MAX_NAME: usize = 40;
/// Most bytes of a character in UTF-8.
const MAX_CHAR_BYTES: usize = 4;

/// A method that makes images of target views.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, strum::IntoStaticStr)]
#[strum(serialize_all = "snake_case")]
pub enum Method {
    /// Condensed K-means clusters: the method of the paper.
    Clift,
    /// Centroid tokens of K-means clusters, without condenser.
    Kmeans,
    /// Centre tokens of rectangular tiles of the context views, without condenser.
    Tile,
    /// Condensed tiles, with a condenser trained on tiles.
    TileClift,
    /// A random subset of all tokens.
    Random,
    /// All tokens of a network without clusters.
    Whole(Architecture),
    /// Baseline: the nearest context view.
    NearestView,
    /// Baseline: the mean of the context views.
    MeanImage,
    /// Images of a method of another program.
    External(MethodName),
}

impl Method {
    /// Returns the methods of this program.
    pub fn own() -> impl Iterator<Item = Self> {
        let clustered = [Self::Clift, Self::Kmeans, Self::Tile, Self::TileClift, Self::Random];
        clustered.into_iter().chain(Self::whole()).chain([Self::NearestView, Self::MeanImage])
    }

    /// Returns the methods of the networks without clusters.
    pub fn whole() -> impl Iterator<Item = Self> {
        let architectures = Architecture::ALL.iter().copied();
        architectures.filter(|architecture| !architecture.supports_clusters()).map(Self::Whole)
    }

    /// Returns the network without clusters whose method it is.
    pub const fn network(self) -> Option<Architecture> {
        match self {
            Self::Whole(architecture) => Some(architecture),
            _ => None,
        }
    }

    /// Returns the name in files and tables.
    pub fn name(&self) -> &str {
        match self {
            Self::External(name) => name.as_str(),
            Self::Whole(architecture) => architecture.method_name(),
            own => (*own).into(),
        }
    }

    /// Returns the grouping whose groups the tokens of a method stand for; `None` of methods without groups.
    pub const fn grouping(self) -> Option<Grouping> {
        match self {
            Self::Clift | Self::Kmeans => Some(Grouping::Kmeans),
            Self::TileClift | Self::Tile => Some(Grouping::Tile),
            Self::Random | Self::Whole(_) | Self::NearestView | Self::MeanImage | Self::External(_) => None,
        }
    }

    /// Returns the method whose tokens are groups of such a grouping, condensed by stage 2.
    pub const fn condensed(grouping: Grouping) -> Self {
        match grouping {
            Grouping::Kmeans => Self::Clift,
            Grouping::Tile => Self::TileClift,
        }
    }

    /// Returns whether stage 2 condenses the groups of a method.
    pub fn is_condensed(self) -> bool {
        self.grouping().is_some_and(|grouping| self == Self::condensed(grouping))
    }
}

/// Name of an external method, in place: a [`Method`] is copied as often as a number.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct MethodName(ArrayString<{ MAX_NAME * MAX_CHAR_BYTES }>);

impl MethodName {
    /// Checks a name: 1 to 40 printable characters, not the name of an own method.
    pub fn new(name: &str) -> Result<Self, EvalError> {
        let bad = |reason: &str| EvalError::BadMethodName { name: name.into(), reason: reason.into() };
        if name.trim().is_empty() || name.chars().count() > MAX_NAME || name.chars().any(char::is_control) {
            return Err(bad("use 1 to 40 printable characters"));
        }
        if Method::own().any(|own| own.name() == name) {
            return Err(bad("reserved for a method of clift; choose another name"));
        }
        ArrayString::from(name).map(Self).map_err(|_| bad("use 1 to 40 printable characters"))
    }

    /// Returns the name.
    pub fn as_str(&self) -> &str {
        self.0.as_str()
    }
}

impl FromStr for Method {
    type Err = EvalError;

    fn from_str(name: &str) -> Result<Self, EvalError> {
        let own = Self::own().find(|method| method.name() == name);
        own.map_or_else(|| MethodName::new(name).map(Self::External), Ok)
    }
}

impl Serialize for Method {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(self.name())
    }
}

impl<'de> Deserialize<'de> for Method {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        String::deserialize(deserializer)?.parse().map_err(serde::de::Error::custom)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_printable_and_not_reserved() {
        for name in ["", " ", "clift", "kmeans", "a\nb", &"x".repeat(41)] {
            assert!(MethodName::new(name).is_err(), "{name:?}");
        }
        let name = MethodName::new("LVSM (2 views)").unwrap();
        assert_eq!(name, MethodName::new("LVSM (2 views)").unwrap());
        assert!(MethodName::new("LVSM").unwrap() < name);
        assert_eq!(MethodName::new(&"\u{1f600}".repeat(40)).unwrap().as_str().chars().count(), 40);
        assert_eq!(name.as_str(), "LVSM (2 views)");
    }

    #[test]
    fn names_are_equal_in_json_and_csv() {
        let other = Method::External(MethodName::new("MVSplat").unwrap());
        for method in Method::own().chain([other]) {
            assert_eq!(serde_json::to_value(method).unwrap(), method.name());
            assert_eq!(serde_json::from_value::<Method>(method.name().into()).unwrap(), method);
        }
        let own: Vec<Method> = Method::own().collect();
        let names: Vec<&str> = own.iter().map(Method::name).collect();
        assert_eq!(names[3..7], ["tile_clift", "random", "lvsm_ed", "nearest_view"]);
        assert!(serde_json::from_value::<Method>("".into()).is_err());
    }
}
