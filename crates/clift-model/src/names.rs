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
///
/// # Errors
/// [`ModelError::BadConfig`] with all names, for an unknown name.
pub fn parse_value<T: Named>(key: &'static str, name: &str) -> Result<T, ModelError> {
    parse_variant(name).ok_or_else(|| ModelError::BadConfig {
        key,
        value: name.into(),
        fix: format!("write one of {}", names::<T>()),
    })
}

#[cfg(test)]
mod tests {
    use std::fmt::{Debug, Display};
    use std::str::FromStr;

    use super::*;
    use crate::cost::macs::FlopConvention;
    use crate::device::name::DeviceName;
    use crate::network::architecture::CliftVariant;
    use crate::ops::precision::Precision;
    use crate::tokens::kind::TokenKind;
    use crate::tokens::selection::rules::SelectionPreset;

    fn check<T>(expected: &str)
    where
        T: Named + Debug + Display + FromStr + PartialEq,
        T::Err: Debug,
    {
        assert_eq!(names::<T>(), expected);
        for &variant in T::VARIANTS {
            assert_eq!(variant.to_string().parse::<T>().unwrap(), variant);
        }
        assert!("other".parse::<T>().is_err());
    }

    #[test]
    fn every_variant_is_printed_and_parsed_by_its_name() {
        check::<FlopConvention>("paper, macs, flops");
        check::<DeviceName>("flex, ndarray, wgpu");
        check::<Precision>("f32, bf16, f16");
        check::<SelectionPreset>("paper, global, scaled");
        check::<CliftVariant>("paper, released-re10k, released-dl3dv");
        assert_eq!(names::<TokenKind>(), "clift, kmeans, latents");
        let message = parse_value::<FlopConvention>("convention", "flop").unwrap_err().to_string();
        assert_eq!(message, "`convention` = flop: write one of paper, macs, flops");
    }
}
