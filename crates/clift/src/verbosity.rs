//! How much goes to the standard error: the option `--quiet`.

use std::sync::{Mutex, PoisonError};

/// Amount of notes and progress.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verbosity {
    /// Errors and warnings only.
    Quiet,
    /// Notes and progress, too.
    Normal,
    /// Nothing, errors included: rank 0 prints for all.
    Silent,
}

static CHOSEN: Mutex<Verbosity> = Mutex::new(Verbosity::Normal);

impl Verbosity {
    pub fn choose(self) {
        *CHOSEN.lock().unwrap_or_else(PoisonError::into_inner) = self;
    }

    pub fn chosen() -> Self {
        *CHOSEN.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
