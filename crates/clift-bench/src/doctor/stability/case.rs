//! A hard case, its bound and its outcome.

use burn::tensor::Device;
use clift_train::TrainError;

/// Size of the cases.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CaseSize {
    /// For tests: all cases take seconds.
    Small,
    /// For the table: all cases take minutes.
    Full,
}

impl CaseSize {
    pub(crate) fn pick<T>(self, small: T, full: T) -> T {
        match self {
            Self::Small => small,
            Self::Full => full,
        }
    }
}

#[derive(Clone, Debug)]
pub struct CaseDevices {
    /// Device of the case, without autodiff.
    pub device: Device,
    /// Flex: its f64 uses the composed operations instead of the f32 kernels.
    pub reference: Device,
    pub size: CaseSize,
}

/// Returns the largest difference from f64, relative to the largest value unless the case has another reason.
pub(crate) type RunCase = fn(&CaseDevices) -> Result<f64, TrainError>;

/// One hard case.
#[derive(Clone, Copy, Debug)]
pub struct StabilityCase {
    /// Extreme property of the input.
    pub name: &'static str,
    /// Computation at risk.
    pub breaks: &'static str,
    /// Largest error.
    pub bound: f64,
    /// Reason for the bound.
    pub reason: &'static str,
    pub(crate) run: RunCase,
}

impl StabilityCase {
    /// Makes the case of a whole update, whose bound is the rounding of f32 through all blocks.
    pub(crate) const fn update(name: &'static str, breaks: &'static str, run: RunCase) -> Self {
        let reason = "f32 through every block, forward and back: 1e-5 a block";
        Self { name, breaks, bound: 1e-4, reason, run }
    }
}

/// One case on every device.
#[derive(Clone, Debug)]
pub struct StabilityRow {
    /// The case.
    pub case: StabilityCase,
    /// Error against f64, or error message, per device.
    pub outcomes: Vec<Result<f64, String>>,
}

impl StabilityRow {
    /// Whether the case is within its bound on every device.
    pub fn is_within_bound(&self) -> bool {
        self.outcomes.iter().all(|outcome| outcome.as_ref().is_ok_and(|error| *error <= self.case.bound))
    }
}
