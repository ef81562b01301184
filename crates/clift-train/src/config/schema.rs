//! Keys of a configuration type, derived from its deserialization, and the key nearest to a misspelled one.

use serde::de::value::{Error, StrDeserializer};
use serde::de::{DeserializeOwned, DeserializeSeed, Deserializer, Error as _, IntoDeserializer, MapAccess, Visitor};

/// Keys of a struct and of the structs in it; other values have none.
#[derive(Debug, Default, PartialEq, Eq)]
pub(crate) struct Keys {
    /// Keys with the keys below them; `None` for maps and for values without keys.
    pub(crate) fields: Option<Vec<(&'static str, Keys)>>,
}

impl Keys {
    /// Returns the keys of `T`. Starts one deserialization per key, which ends when a struct passes its field names.
    pub(crate) fn of<T: DeserializeOwned>() -> Self {
        Self::below::<T>(&mut Vec::new())
    }

    fn below<T: DeserializeOwned>(path: &mut Vec<&'static str>) -> Self {
        let mut names = None;
        let _abandoned = T::deserialize(Probe { path, names: &mut names });
        let fields = names.filter(|_| path.len() < 8).map(|names| {
            let below = names.iter().map(|&name| {
                path.push(name);
                let keys = Self::below::<T>(path);
                path.pop();
                (name, keys)
            });
            below.collect()
        });
        Self { fields }
    }

    pub(crate) fn get(&self, key: &str) -> Option<&Self> {
        self.fields.as_ref()?.iter().find(|(name, _)| *name == key).map(|(_, keys)| keys)
    }

    pub(crate) fn names(&self) -> impl Iterator<Item = &'static str> {
        self.fields.iter().flatten().map(|(name, _)| *name)
    }

    /// Returns the key most similar to `key`, if similar enough for a typing error.
    pub(crate) fn nearest(&self, key: &str) -> Option<&'static str> {
        nearest(key, self.names())
    }

    /// Returns the sections below this one that have `key`, as dotted paths.
    pub(crate) fn sections_with(&self, key: &str) -> Vec<String> {
        let mut found = Vec::new();
        for (name, keys) in self.fields.iter().flatten() {
            if keys.get(key).is_some() {
                found.push((*name).to_owned());
            }
            found.extend(keys.sections_with(key).into_iter().map(|section| format!("{name}.{section}")));
        }
        found
    }
}

/// Returns the candidate with the smallest edit distance, if that is at most a third of the word.
pub(crate) fn nearest<'a>(word: &str, candidates: impl Iterator<Item = &'a str>) -> Option<&'a str> {
    candidates
        .map(|candidate| (strsim::damerau_levenshtein(word, candidate), candidate))
        .filter(|(distance, candidate)| *distance <= (word.len().max(candidate.len()) / 3).max(1))
        .min_by_key(|(distance, _)| *distance)
        .map(|(_, candidate)| candidate)
}

/// Deserializer that follows `path` and stores the field names of the struct at its end.
struct Probe<'a> {
    path: &'a [&'static str],
    names: &'a mut Option<&'static [&'static str]>,
}

impl<'de> Deserializer<'de> for Probe<'_> {
    type Error = Error;

    fn deserialize_any<V: Visitor<'de>>(self, _visitor: V) -> Result<V::Value, Error> {
        Err(Error::custom("a probe holds no value"))
    }

    fn deserialize_struct<V: Visitor<'de>>(
        self,
        _name: &'static str,
        fields: &'static [&'static str],
        visitor: V,
    ) -> Result<V::Value, Error> {
        if self.path.is_empty() {
            *self.names = Some(fields);
            return self.deserialize_any(visitor);
        }
        visitor.visit_map(self)
    }

    fn deserialize_option<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, Error> {
        visitor.visit_some(self)
    }

    fn deserialize_newtype_struct<V: Visitor<'de>>(self, _name: &'static str, visitor: V) -> Result<V::Value, Error> {
        visitor.visit_newtype_struct(self)
    }

    serde::forward_to_deserialize_any! {
        bool i8 i16 i32 i64 i128 u8 u16 u32 u64 u128 f32 f64 char str string bytes byte_buf unit unit_struct
        seq tuple tuple_struct map enum identifier ignored_any
    }
}

impl<'de> MapAccess<'de> for Probe<'_> {
    type Error = Error;

    fn next_key_seed<K: DeserializeSeed<'de>>(&mut self, seed: K) -> Result<Option<K::Value>, Error> {
        let Some(key) = self.path.first() else { return Ok(None) };
        let key: StrDeserializer<'_, Error> = key.into_deserializer();
        seed.deserialize(key).map(Some)
    }

    fn next_value_seed<V: DeserializeSeed<'de>>(&mut self, seed: V) -> Result<V::Value, Error> {
        seed.deserialize(Probe { path: &self.path[1..], names: &mut *self.names })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::config::Config;

    #[test]
    fn keys_of_a_type_include_those_of_its_sections() {
        let keys = Keys::of::<Config>();
        assert!(keys.names().take(2).eq(["run_dir", "seed"]));
        let kmeans = keys.get("clusters").and_then(|clusters| clusters.get("kmeans")).unwrap();
        assert!(kmeans.names().eq(["max_iterations", "tolerance"]));
        assert_eq!(keys.get("seed").unwrap().fields, None);
        assert_eq!(keys.sections_with("tolerance"), ["clusters.kmeans"]);
    }

    #[test]
    fn nearest_key_is_within_the_edit_distance() {
        let near = |word| nearest(word, ["num_heads", "dim", "steps"].into_iter());
        assert_eq!(near("num_head"), Some("num_heads"));
        assert_eq!(near("step"), Some("steps"));
        assert_eq!(near("din"), Some("dim"));
        assert_eq!(near("learning_rate"), None);
    }
}
