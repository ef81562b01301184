//! Rendering methods and two baselines.

use std::str::FromStr;

use clift_model::{Architecture, Grouping};
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use crate::error::EvalError;

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
            Self::Whole(architecture) => architecture.method_name(),
            own => (*own).into(),
        }
    }

    /// Returns the grouping whose groups the tokens of a method stand for; `None` of methods without groups.
    pub const fn grouping(self) -> Option<Grouping> {
        match self {
            Self::Clift | Self::Kmeans => Some(Grouping::Kmeans),
            Self::TileClift | Self::Tile => Some(Grouping::Tile),
            Self::Random | Self::Whole(_) | Self::NearestView | Self::MeanImage => None,
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

impl FromStr for Method {
    type Err = EvalError;

    fn from_str(name: &str) -> Result<Self, EvalError> {
        let own = Self::own().find(|method| method.name() == name);
        own.ok_or_else(|| {
            let names = Self::own().map(|method| method.name().to_owned()).collect::<Vec<_>>().join(", ");
            EvalError::BadMethodName { name: name.into(), names }
        })
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
    fn names_are_equal_in_json_and_csv() {
        for method in Method::own() {
            assert_eq!(serde_json::to_value(method).unwrap(), method.name());
            assert_eq!(serde_json::from_value::<Method>(method.name().into()).unwrap(), method);
        }
        let own: Vec<Method> = Method::own().collect();
        let names: Vec<&str> = own.iter().map(Method::name).collect();
        assert_eq!(names[3..7], ["tile_clift", "random", "lvsm_ed", "nearest_view"]);
        let message = serde_json::from_value::<Method>("lvsm".into()).unwrap_err().to_string();
        assert!(message.contains("unknown method `lvsm`; write one of clift, kmeans, tile, tile_clift"), "{message}");
    }
}
