use std::fmt;
use std::sync::OnceLock;

use crate::simd::portable::Portable;
use crate::simd::vector::Simd;

#[cfg(target_arch = "x86_64")]
use crate::simd::avx2::Avx2;

#[cfg(target_arch = "x86_64")]
use crate::simd::avx512::Avx512;

/// What a kernel is compiled for. The variants exist on every processor; [`InstructionSet::available`]
/// says which can run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum InstructionSet {
    /// Whatever the compiler's baseline has.
    Portable,
    /// x86-64 with AVX2 and FMA.
    Avx2,
    /// x86-64 with AVX-512 F, VL, BW and DQ.
    Avx512,
}

/// A value of [`InstructionSet::VARIABLE`] that cannot be followed.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct InstructionSetError {
    /// What it holds.
    pub text: String,
    /// Whether it is an instruction set, which this processor lacks.
    pub is_known: bool,
}

impl fmt::Display for InstructionSetError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let names = InstructionSet::available().map(InstructionSet::name).collect::<Vec<_>>().join(", ");
        let why = if self.is_known { "this processor does not have it" } else { "it is no instruction set" };
        write!(f, "{why}; it can be one of {names}, or left out for the first of them")
    }
}

impl std::error::Error for InstructionSetError {}

/// Work that is generic over the instruction set. `run` must be `#[inline(always)]`.
pub(crate) trait Kernel {
    type Output;

    fn run<S: Simd>(self, simd: S) -> Self::Output;
}

impl InstructionSet {
    /// All of them, the widest first.
    pub const ALL: [Self; 3] = [Self::Avx512, Self::Avx2, Self::Portable];

    /// The environment variable that forces an instruction set: `avx512`, `avx2` or `portable`.
    pub const VARIABLE: &str = "CLIFT_INSTRUCTION_SET";

    /// The one to use: what [`InstructionSet::VARIABLE`] names, or else the widest that the processor has. Read once
    /// per process.
    ///
    /// A kernel cannot refuse what is not there, so that it takes the widest then, too: a program asks
    /// [`InstructionSet::forced`] at its start.
    pub fn detected() -> Self {
        static DETECTED: OnceLock<InstructionSet> = OnceLock::new();
        *DETECTED.get_or_init(|| Self::forced().ok().flatten().unwrap_or_else(Self::widest))
    }

    /// The widest that this processor can run.
    pub fn widest() -> Self {
        Self::available().next().unwrap_or(Self::Portable)
    }

    /// What [`InstructionSet::VARIABLE`] names; `None` where it is not set or empty.
    ///
    /// # Errors
    /// The text and what it may be, where it names no instruction set that this processor has.
    pub fn forced() -> Result<Option<Self>, InstructionSetError> {
        match std::env::var_os(Self::VARIABLE) {
            None => Ok(None),
            Some(text) => Self::parse(&text.to_string_lossy()),
        }
    }

    fn parse(text: &str) -> Result<Option<Self>, InstructionSetError> {
        if text.is_empty() {
            return Ok(None);
        }
        let bad = |is_known| InstructionSetError { text: text.to_owned(), is_known };
        let known = Self::ALL.into_iter().find(|set| set.name() == text).ok_or_else(|| bad(false))?;
        if known.is_available() { Ok(Some(known)) } else { Err(bad(true)) }
    }

    /// Those that this processor can run, the widest first.
    pub fn available() -> impl Iterator<Item = Self> {
        Self::ALL.into_iter().filter(|set| set.is_available())
    }

    /// The name in lower case.
    pub fn name(self) -> &'static str {
        match self {
            Self::Portable => "portable",
            Self::Avx2 => "avx2",
            Self::Avx512 => "avx512",
        }
    }

    #[cfg(target_arch = "x86_64")]
    fn is_available(self) -> bool {
        match self {
            Self::Portable => true,
            Self::Avx2 => is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma"),
            Self::Avx512 => {
                is_x86_feature_detected!("avx512f")
                    && is_x86_feature_detected!("avx512vl")
                    && is_x86_feature_detected!("avx512bw")
                    && is_x86_feature_detected!("avx512dq")
                    && Self::Avx2.is_available()
            }
        }
    }

    #[cfg(not(target_arch = "x86_64"))]
    fn is_available(self) -> bool {
        self == Self::Portable
    }

    /// Runs a kernel compiled for this instruction set, on this thread.
    ///
    /// # Panics
    /// When the processor does not have it.
    #[cfg(target_arch = "x86_64")]
    pub(crate) fn run<K: Kernel>(self, kernel: K) -> K::Output {
        assert!(self.is_available(), "this processor has no {}", self.name());
        match self {
            Self::Portable => kernel.run(Portable),
            // SAFETY: checked above.
            Self::Avx2 => unsafe { run_avx2(kernel) },
            // SAFETY: checked above.
            Self::Avx512 => unsafe { run_avx512(kernel) },
        }
    }

    /// Runs a kernel compiled for this instruction set, on this thread.
    #[cfg(not(target_arch = "x86_64"))]
    pub(crate) fn run<K: Kernel>(self, kernel: K) -> K::Output {
        assert!(self.is_available(), "this processor has no {}", self.name());
        kernel.run(Portable)
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn run_avx2<K: Kernel>(kernel: K) -> K::Output {
    // SAFETY: this function is compiled for, and so only called on, such a processor.
    kernel.run(unsafe { Avx2::new() })
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512vl,avx512bw,avx512dq,avx2,fma")]
fn run_avx512<K: Kernel>(kernel: K) -> K::Output {
    // SAFETY: this function is compiled for, and so only called on, such a processor.
    kernel.run(unsafe { Avx512::new() })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_asked_for_is_taken_or_refused_by_name() {
        assert_eq!(InstructionSet::parse(""), Ok(None));
        assert_eq!(InstructionSet::parse("portable"), Ok(Some(InstructionSet::Portable)));
        for set in InstructionSet::ALL {
            let parsed = InstructionSet::parse(set.name());
            assert_eq!(parsed.is_ok(), set.is_available(), "{}", set.name());
        }
        let message = InstructionSet::parse("AVX2").unwrap_err().to_string();
        assert!(message.starts_with("it is no instruction set; it can be one of "), "{message}");
        assert!(message.contains("portable"), "{message}");
    }
}
