//! A hard case and its bound.

use burn::tensor::Device;
use clift_train::TrainError;

use crate::doctor::stability::{attention, clusters, poses, tokens, training, updates};

/// How large the cases are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Size {
    /// For tests: seconds for all of them.
    Small,
    /// For the table: minutes.
    Full,
}

impl Size {
    /// One of two numbers.
    pub(crate) fn pick<T>(self, small: T, full: T) -> T {
        match self {
            Self::Small => small,
            Self::Full => full,
        }
    }
}

/// Where a case is computed, and where its f64 reference.
#[derive(Clone, Debug)]
pub struct CaseDevices {
    /// Without autodiff.
    pub device: Device,
    /// Flex, whose f64 goes through the composed operations, not through the kernels for f32.
    pub reference: Device,
    /// How large.
    pub size: Size,
}

/// What a case came to.
#[derive(Clone, Debug, PartialEq)]
pub enum Outcome {
    /// The largest difference from f64, over the largest value unless the bound's reason says otherwise.
    Error(f64),
    /// The input was refused, with these words.
    Refused(String),
}

/// What a case has to come to.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Bound {
    /// At most this error.
    Most(f64),
    /// A refusal that says this.
    Refused(&'static str),
}

/// One hard case.
#[derive(Clone, Copy, Debug)]
pub struct Case {
    /// What is hard.
    pub name: &'static str,
    /// What could break.
    pub breaks: &'static str,
    /// What it has to come to.
    pub bound: Bound,
    /// Why that.
    pub reason: &'static str,
    pub(crate) run: fn(&CaseDevices) -> Result<Outcome, TrainError>,
}

impl Case {
    /// All cases, in the order of the table.
    pub fn all() -> impl Iterator<Item = Self> {
        [updates::CASES, poses::CASES, clusters::CASES, attention::CASES, training::CASES, tokens::CASES]
            .into_iter()
            .flatten()
            .copied()
    }

    /// Computes it.
    ///
    /// # Errors
    /// Whatever data or model refuse where the case does not expect it.
    pub fn run(&self, place: &CaseDevices) -> Result<Outcome, TrainError> {
        (self.run)(place)
    }

    /// Whether an outcome is what it has to be.
    pub fn holds(&self, outcome: &Outcome) -> bool {
        match (self.bound, outcome) {
            (Bound::Most(most), Outcome::Error(error)) => *error <= most,
            (Bound::Refused(words), Outcome::Refused(said)) => said.contains(words),
            _ => false,
        }
    }
}

/// One case on every device.
#[derive(Clone, Debug)]
pub struct Row {
    /// The case.
    pub case: Case,
    /// What it came to, or why it failed, device by device.
    pub outcomes: Vec<Result<Outcome, String>>,
}

impl Row {
    /// Whether the case holds on every device.
    pub fn holds(&self) -> bool {
        self.outcomes.iter().all(|outcome| outcome.as_ref().is_ok_and(|outcome| self.case.holds(outcome)))
    }
}
