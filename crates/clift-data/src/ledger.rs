//! The ledger of what was left out: every skipped scene with its reason, counted and printable.

use std::collections::BTreeMap;
use std::fmt;

use serde::{Deserialize, Serialize};

/// One scene that was left out.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Skip {
    /// Key of the scene.
    pub key: String,
    /// Why, in words that equal cases share, so that they can be counted.
    pub reason: String,
}

/// How many scenes there were and which were left out. Prints as `2 of 3 scenes used; 1 shorter than 46 frames`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Ledger {
    /// Scenes looked at, used or not.
    pub num_scenes: usize,
    /// Scenes left out, in the order they were met.
    pub skips: Vec<Skip>,
}

impl Ledger {
    /// A ledger of `num_scenes` scenes of which none is left out yet.
    pub fn new(num_scenes: usize) -> Self {
        Self { num_scenes, skips: Vec::new() }
    }

    /// Notes that a scene is left out.
    pub fn skip(&mut self, key: impl Into<String>, reason: impl Into<String>) {
        self.skips.push(Skip { key: key.into(), reason: reason.into() });
    }

    /// Scenes that are used.
    pub fn num_used(&self) -> usize {
        self.num_scenes.saturating_sub(self.skips.len())
    }

    /// How many scenes each reason left out, by reason.
    pub fn counts(&self) -> BTreeMap<&str, usize> {
        let mut counts = BTreeMap::new();
        for skip in &self.skips {
            *counts.entry(skip.reason.as_str()).or_insert(0) += 1;
        }
        counts
    }
}

impl fmt::Display for Ledger {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} of {} scenes used", self.num_used(), self.num_scenes)?;
        for (reason, count) in self.counts() {
            write!(f, "; {count} {reason}")?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ledger_prints_used_and_total_and_counts_each_reason() {
        let mut ledger = Ledger::new(5);
        assert_eq!(ledger.to_string(), "5 of 5 scenes used");
        ledger.skip("a", "shorter than 46 frames");
        ledger.skip("b", "null in the evaluation index");
        ledger.skip("c", "shorter than 46 frames");
        assert_eq!(ledger.to_string(), "2 of 5 scenes used; 1 null in the evaluation index; 2 shorter than 46 frames");
    }
}
