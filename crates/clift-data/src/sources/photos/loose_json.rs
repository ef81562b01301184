//! JSON as the programs of captures write it: words for NaN, and lists of bounded length.

use std::fmt;
use std::marker::PhantomData;

use serde::de::{DeserializeOwned, Error, SeqAccess, Visitor};
use serde::{Deserialize, Deserializer};

use crate::files::bounded::parse_json;

/// Parses a document. Python and C++ write NaN and infinite numbers, which JSON does not have.
pub(crate) fn parse<T: DeserializeOwned>(text: &[u8]) -> Result<T, serde_json::Error> {
    parse_json(text).or_else(|error| parse_json(&with_quoted_numbers(text).ok_or(error)?))
}

/// Returns JSON text with words such as `NaN`, `-Infinity` and `-nan(ind)` in quotes; `None` without such words.
fn with_quoted_numbers(text: &[u8]) -> Option<Vec<u8>> {
    let (mut quoted, mut is_string, mut at, mut has_words) = (Vec::with_capacity(text.len() + 64), false, 0, false);
    while let Some(&byte) = text.get(at) {
        let is_part = |byte: &u8| byte.is_ascii_alphanumeric() || b"+-.()#_".contains(byte);
        let length = if is_string { 0 } else { text[at..].iter().take_while(|byte| is_part(byte)).count() };
        let word = &text[at..at + length];
        let lower = word.iter().take(16).map(u8::to_ascii_lowercase).collect::<Vec<u8>>();
        if [&b"nan"[..], b"inf", b"#ind", b"#qnan"].iter().any(|part| lower.windows(part.len()).any(|w| w == *part)) {
            quoted.extend([b"\"", word, b"\""].concat());
            has_words = true;
        } else if length > 0 {
            quoted.extend(word);
        } else {
            let length = if is_string && byte == b'\\' { 2 } else { 1 };
            is_string ^= byte == b'"';
            quoted.extend(text[at..].iter().take(length));
            at += length;
        }
        at += word.len();
    }
    has_words.then_some(quoted)
}

/// A number, NaN for null and for the text of [`with_quoted_numbers`].
#[derive(Clone, Copy)]
pub(crate) struct Number(pub f64);

impl<'de> Deserialize<'de> for Number {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(NumberVisitor)
    }
}

struct NumberVisitor;

impl Visitor<'_> for NumberVisitor {
    type Value = Number;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a number")
    }

    fn visit_f64<E>(self, value: f64) -> Result<Number, E> {
        Ok(Number(value))
    }

    fn visit_i64<E>(self, value: i64) -> Result<Number, E> {
        Ok(Number(value as f64))
    }

    fn visit_u64<E>(self, value: u64) -> Result<Number, E> {
        Ok(Number(value as f64))
    }

    fn visit_str<E: Error>(self, text: &str) -> Result<Number, E> {
        Ok(Number(text.parse().unwrap_or(f64::NAN)))
    }

    fn visit_unit<E>(self) -> Result<Number, E> {
        Ok(Number(f64::NAN))
    }
}

pub(crate) fn values<const N: usize>(numbers: [Option<Number>; N]) -> [Option<f64>; N] {
    numbers.map(|number| number.map(|Number(value)| value))
}

/// A list of at most `MAX` items, because parsed JSON takes up to a hundred times the memory of its text.
pub(crate) struct Bounded<T, const MAX: usize>(pub Vec<T>);

impl<'de, T: Deserialize<'de>, const MAX: usize> Deserialize<'de> for Bounded<T, MAX> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_seq(BoundedVisitor(PhantomData))
    }
}

struct BoundedVisitor<T, const MAX: usize>(PhantomData<T>);

impl<'de, T: Deserialize<'de>, const MAX: usize> Visitor<'de> for BoundedVisitor<T, MAX> {
    type Value = Bounded<T, MAX>;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "a list of at most {MAX}")
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut items: A) -> Result<Self::Value, A::Error> {
        let mut list = Vec::new();
        while let Some(item) = items.next_element()? {
            if list.len() == MAX {
                return Err(A::Error::custom(format!("a list of more than {MAX} items")));
            }
            list.push(item);
        }
        Ok(Bounded(list))
    }
}
