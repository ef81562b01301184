//! How much goes to the standard error: the option `--quiet`.

use std::sync::atomic::{AtomicU8, Ordering};

/// Amount of notes and progress.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(u8)]
pub enum Verbosity {
    /// Errors and warnings only.
    Quiet = 0,
    /// Notes and progress, too.
    #[default]
    Normal = 1,
    /// Nothing, errors included: rank 0 prints for all.
    Silent = 2,
}

static CHOSEN: AtomicU8 = AtomicU8::new(Verbosity::Normal as u8);

impl Verbosity {
    pub fn choose(self) {
        CHOSEN.store(self as u8, Ordering::Relaxed);
    }

    pub fn chosen() -> Self {
        match CHOSEN.load(Ordering::Relaxed) {
            0 => Self::Quiet,
            2 => Self::Silent,
            _ => Self::Normal,
        }
    }
}
