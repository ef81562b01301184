//! Enums by the names of their variants, for configs and the command line.

use strum::VariantArray;

use crate::error::ModelError;

/// An enum with named variants, by strum's derives `VariantArray` and `IntoStaticStr`.
pub trait Named: Copy + VariantArray + Into<&'static str> {}

impl<T: Copy + VariantArray + Into<&'static str>> Named for T {}

/// Returns the names of all variants, joined by commas.
pub fn names<T: Named>() -> String {
    T::VARIANTS.iter().map(|&variant| variant.into()).collect::<Vec<&str>>().join(", ")
}

/// Returns the variant with a name.
pub fn parse_variant<T: Named>(name: &str) -> Option<T> {
    T::VARIANTS.iter().copied().find(|&variant| variant.into() == name)
}

/// Returns the variant with a name, the value of `key`.
pub fn parse_value<T: Named>(key: &'static str, name: &str) -> Result<T, ModelError> {
    parse_variant(name).ok_or_else(|| ModelError::BadConfig {
        key,
        value: name.into(),
        fix: format!("write one of {}", names::<T>()),
    })
}
