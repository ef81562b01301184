//! Formats of the tokens of a scene file: plain numbers, or coded.

use std::fmt;
use std::str::FromStr;

use clift_model::ModelError;
use serde::{Deserialize, Serialize};

use crate::scene::token_format::TokenFormat;

/// Storage of tokens in configs, tables and on the command line: `f32`, `f16`, `int8`, `coded` or `coded-DB`.
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
    /// Plain 8-bit integers.
    pub const INT8: Self = Self::Plain(TokenFormat::Int8);
    /// The names for messages and help texts.
    pub const NAMES: &str = "f32, f16, int8, coded, coded-DB";
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
            let format = clift_model::parse_variant(name).map(Self::Plain);
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_parse_and_others_are_refused() {
        for name in ["f32", "f16", "int8", "coded", "coded-0.1", "coded-2"] {
            assert_eq!(name.parse::<TokenCoding>().unwrap().to_string(), name);
        }
        assert_eq!("coded-0.02".parse::<TokenCoding>().unwrap().to_string(), "coded");
        for name in ["coded-", "coded-0", "coded-nan", "coded-1e9", "coded0.1", "f64", ""] {
            let message = name.parse::<TokenCoding>().unwrap_err().to_string();
            assert!(message.starts_with(&format!("`tokens` = {name}: write ")), "{message}");
        }
        let json = serde_json::to_string(&"coded-0.1".parse::<TokenCoding>().unwrap()).unwrap();
        assert_eq!(json, "\"coded-0.1\"");
        assert!(
            serde_json::from_str::<TokenCoding>(&json).is_ok()
                && serde_json::from_str::<TokenCoding>("\"f8\"").is_err()
        );
    }
}
