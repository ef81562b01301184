//! Enums by the names of their variants, as a config or the command line gives them.

use strum::VariantArray;

use crate::error::ModelError;

/// Returns the names of all variants, joined by commas.
pub fn names<T: Copy + VariantArray + Into<&'static str>>() -> String {
    T::VARIANTS.iter().map(|&variant| variant.into()).collect::<Vec<&str>>().join(", ")
}

/// Finds the variant of a name.
pub fn parse<T: Copy + VariantArray + Into<&'static str>>(name: &str) -> Option<T> {
    T::VARIANTS.iter().copied().find(|&variant| variant.into() == name)
}

/// Finds the variant of a name that `key` was given.
///
/// # Errors
/// [`ModelError::BadConfig`] with all names.
pub fn parse_value<T>(key: &'static str, name: &str) -> Result<T, ModelError>
where
    T: Copy + VariantArray + Into<&'static str>,
{
    let fix = || format!("write one of {}", names::<T>());
    parse(name).ok_or_else(|| ModelError::BadConfig { key, value: name.into(), fix: fix() })
}
