//! A number or share of tokens.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Deserializer, Serialize, Serializer};

use crate::error::ModelError;

/// A number of tokens (`256`) or a share of all tokens (`"1/16"`, `0.0625`) in configs and on the command line.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum TokenCount {
    /// Number of tokens, at least one.
    Count(usize),
    /// Share of all tokens in `(0, 1]`, rounded down to at least one token.
    Share(f64),
}

impl TokenCount {
    /// Returns the number of tokens for a scene of `num_tokens`.
    pub fn of(self, num_tokens: usize) -> Result<usize, ModelError> {
        let bad = |reason: String| Err(ModelError::BadTokenCount { text: self.to_string(), reason });
        match self {
            _ if num_tokens == 0 => bad("a scene without views has no tokens".into()),
            Self::Count(count) if (1..=num_tokens).contains(&count) => Ok(count),
            Self::Count(_) => bad(format!("a scene has {num_tokens} tokens")),
            // The summand corrects rounding: 0.0625 * 48 may be 2.9999...
            Self::Share(share) => Ok(((num_tokens as f64 * share + 1e-9) as usize).clamp(1, num_tokens)),
        }
    }
}

impl FromStr for TokenCount {
    type Err = ModelError;

    fn from_str(text: &str) -> Result<Self, ModelError> {
        let bad = |reason: &str| ModelError::BadTokenCount { text: text.into(), reason: reason.into() };
        let share = |share: f64| {
            if share > 0.0 && share <= 1.0 { Ok(Self::Share(share)) } else { Err(bad("a share lies in (0, 1]")) }
        };
        let text = text.trim();
        if let Some((over, under)) = text.split_once('/') {
            let number = |part: &str| part.trim().parse::<f64>().map_err(|_| bad("write a fraction as 1/16"));
            return share(number(over)? / number(under)?);
        }
        match text.parse::<usize>() {
            Ok(0) => Err(bad("at least one token is needed")),
            Ok(count) => Ok(Self::Count(count)),
            Err(_) => share(text.parse().map_err(|_| bad("write a count (256) or a share (1/16, 0.0625)"))?),
        }
    }
}

impl fmt::Display for TokenCount {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::Count(count) => write!(f, "{count}"),
            Self::Share(share) => {
                let under = (1.0 / share).round();
                if (under * share - 1.0).abs() < 1e-12 { write!(f, "1/{under}") } else { write!(f, "{share}") }
            }
        }
    }
}

impl Serialize for TokenCount {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match *self {
            Self::Count(count) => serializer.serialize_u64(count as u64),
            Self::Share(_) => serializer.collect_str(self),
        }
    }
}

impl<'de> Deserialize<'de> for TokenCount {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        #[derive(Deserialize)]
        #[serde(untagged, expecting = "a count (256) or a share (\"1/16\", 0.0625)")]
        enum Written {
            Count(u64),
            Share(f64),
            Text(String),
        }
        match Written::deserialize(deserializer)? {
            // A float is a share even if it is an integer: 1.0 is all tokens, not one.
            Written::Share(share) => format!("{share:?}").parse(),
            Written::Count(count) => count.to_string().parse(),
            Written::Text(text) => text.parse(),
        }
        .map_err(serde::de::Error::custom)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_and_shares_resolve_against_a_scene() {
        let cases = [
            ("256", 4096, 256),
            ("1/16", 4096, 256),
            ("0.0625", 48, 3),
            ("1/3", 48, 16),
            ("1/1000", 48, 1),
            ("1.0", 48, 48),
        ];
        for (text, num_tokens, expected) in cases {
            assert_eq!(text.parse::<TokenCount>().unwrap().of(num_tokens).unwrap(), expected, "{text}");
        }
        // In JSON too, 1.0 is all tokens.
        let list: Vec<TokenCount> = serde_json::from_str(r#"[16, "1/4", 0.5, 1.0, 1]"#).unwrap();
        assert_eq!(list.iter().map(|count| count.of(64).unwrap()).collect::<Vec<_>>(), [16, 16, 32, 64, 1]);
        let text = serde_json::to_string(&list).unwrap();
        assert_eq!(serde_json::from_str::<Vec<TokenCount>>(&text).unwrap(), list);
    }

    #[test]
    fn invalid_counts_are_refused_with_the_remedy() {
        for (text, part) in [("0", "at least one"), ("3/2", "(0, 1]"), ("x", "write a count"), ("1/x", "as 1/16")] {
            let message = text.parse::<TokenCount>().unwrap_err().to_string();
            assert!(message.contains(part), "{message}");
        }
        assert!(TokenCount::Share(0.5).of(0).is_err());
        assert!(serde_json::from_str::<TokenCount>("-1").unwrap_err().to_string().contains("`-1.0` tokens"));
        assert!(TokenCount::Count(300).of(256).unwrap_err().to_string().contains("a scene has 256 tokens"));
    }
}
