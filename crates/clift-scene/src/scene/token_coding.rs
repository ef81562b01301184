//! Formats of the tokens of a scene file: plain numbers, or coded.

use std::fmt;
use std::str::FromStr;

use clift_model::{ModelError, parse_variant};
use half::f16;
use serde::{Deserialize, Serialize};
use strum::{Display, IntoStaticStr, VariantArray};

use crate::tensors::{f32_bytes, numbers};

/// Storage of tokens in configs, tables and on the command line: `f32`, `f16`, `coded` or `coded-DB`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum TokenCoding {
    /// Numbers of one format.
    Plain(TokenFormat),
    /// Coded with the step that the model's codec measured for a loss.
    Coded(CodedLoss),
}

/// Loss of PSNR of coded tokens, in thousandths of a dB.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct CodedLoss(u32);

impl CodedLoss {
    /// Returns a loss in dB, rounded to thousandths, at least one of them.
    pub fn from_db(loss: f64) -> Self {
        Self((loss * 1e3).round().clamp(1.0, 1e6) as u32)
    }

    /// Returns the loss in dB.
    pub fn db(self) -> f64 {
        f64::from(self.0) / 1e3
    }
}

impl Default for CodedLoss {
    /// 0.02 dB.
    fn default() -> Self {
        Self(20)
    }
}

impl TokenCoding {
    /// Plain 32-bit floats.
    pub const F32: Self = Self::Plain(TokenFormat::F32);
    /// Plain 16-bit floats.
    pub const F16: Self = Self::Plain(TokenFormat::F16);
    /// The names for messages and help texts.
    pub const NAMES: &str = "f32, f16, coded, coded-DB";
}

impl From<TokenFormat> for TokenCoding {
    fn from(format: TokenFormat) -> Self {
        Self::Plain(format)
    }
}

impl fmt::Display for TokenCoding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Plain(format) => f.write_str(format.name()),
            Self::Coded(loss) if *loss == CodedLoss::default() => f.write_str("coded"),
            Self::Coded(loss) => write!(f, "coded-{}", loss.db()),
        }
    }
}

impl FromStr for TokenCoding {
    type Err = ModelError;

    fn from_str(name: &str) -> Result<Self, ModelError> {
        let bad = |fix: String| ModelError::BadConfig { key: "tokens", value: name.into(), fix };
        if name == "coded" {
            return Ok(Self::Coded(CodedLoss::default()));
        }
        let Some(loss) = name.strip_prefix("coded-") else {
            let format = parse_variant(name).map(Self::Plain);
            return format.ok_or_else(|| bad(format!("write one of {}", Self::NAMES)));
        };
        match loss.parse() {
            Ok(loss) if (1e-3..=10.0).contains(&loss) => Ok(Self::Coded(CodedLoss::from_db(loss))),
            _ => Err(bad("write a loss of 0.001 to 10 dB, such as coded-0.1".into())),
        }
    }
}

impl TryFrom<String> for TokenCoding {
    type Error = ModelError;

    fn try_from(name: String) -> Result<Self, ModelError> {
        name.parse()
    }
}

impl From<TokenCoding> for String {
    fn from(storage: TokenCoding) -> Self {
        storage.to_string()
    }
}

/// Number format of the tokens in a scene file.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Display, IntoStaticStr, VariantArray)]
#[strum(serialize_all = "lowercase")]
pub enum TokenFormat {
    /// 32-bit floats, without rounding.
    F32,
    /// 16-bit floats, with a relative error of 5e-4.
    F16,
}

impl TokenFormat {
    /// All formats, in the order of messages and help texts.
    pub const ALL: [Self; 2] = *Self::VARIANTS.as_array().expect("two variants");

    /// Returns the name on the command line.
    pub fn name(self) -> &'static str {
        self.into()
    }

    /// Returns the bytes of one token of width `dim`.
    pub const fn bytes_per_token(self, dim: usize) -> usize {
        match self {
            Self::F32 => 4 * dim,
            Self::F16 => 2 * dim,
        }
    }

    /// Rounds tokens as writing and reading a file does.
    pub fn round(self, tokens: &[f32]) -> Result<Vec<f32>, ModelError> {
        Ok(self.decode(&self.encode(tokens)?))
    }

    /// Encodes tokens as little-endian bytes.
    pub(crate) fn encode(self, tokens: &[f32]) -> Result<Vec<u8>, ModelError> {
        match self {
            Self::F32 => Ok(f32_bytes(tokens.iter().copied())),
            Self::F16 => {
                let rounded: Vec<f16> = tokens.iter().map(|&value| f16::from_f32(value)).collect();
                if let Some(position) = rounded.iter().position(|value| !value.is_finite()) {
                    let value = tokens[position];
                    let fix = format!("a token contains {value}, the largest 16-bit float is 65504; write f32");
                    return Err(ModelError::BadConfig { key: "tokens", value: "f16".into(), fix });
                }
                Ok(rounded.iter().flat_map(|value| value.to_le_bytes()).collect())
            }
        }
    }

    pub(crate) fn decode(self, bytes: &[u8]) -> Vec<f32> {
        match self {
            Self::F32 => numbers(bytes, f32::from_le_bytes),
            Self::F16 => numbers(bytes, |bytes| f16::from_le_bytes(bytes).to_f32()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rounding_errors_are_within_each_formats_bound() {
        let tokens: Vec<f32> = (0..400).map(|i| ((i * 7919 % 1000) as f32 - 500.0) * 0.013).collect();
        assert_eq!(TokenFormat::F32.round(&tokens).unwrap(), tokens);
        for (got, value) in TokenFormat::F16.round(&tokens).unwrap().iter().zip(&tokens) {
            assert!((got - value).abs() <= value.abs() / 2048.0, "{got} against {value}");
        }
        assert_eq!(TokenFormat::F16.round(&[1e-42, -1e-42, 0.0]).unwrap(), [0.0; 3]);
        let message = TokenFormat::F16.round(&[1.0, 7e4]).unwrap_err().to_string();
        assert!(message.ends_with("a token contains 70000, the largest 16-bit float is 65504; write f32"), "{message}");
    }

    #[test]
    fn names_parse_and_others_are_refused() {
        for name in ["f32", "f16", "coded", "coded-0.1", "coded-2"] {
            assert_eq!(name.parse::<TokenCoding>().unwrap().to_string(), name);
        }
        assert_eq!("coded-0.02".parse::<TokenCoding>().unwrap().to_string(), "coded");
        for name in ["coded-", "coded-0", "coded-nan", "coded-1e9", "coded0.1", "f64", ""] {
            let message = name.parse::<TokenCoding>().unwrap_err().to_string();
            assert!(message.starts_with(&format!("`tokens` = {name}: write ")), "{message}");
        }
    }
}
