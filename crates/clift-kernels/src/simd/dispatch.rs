//! The choice of the instruction set, and running a kernel with it.

use std::fmt;
use std::marker::PhantomData;
use std::sync::OnceLock;

use crate::simd::portable::Portable;
use crate::simd::vector::{Bf16, F32, Operands, Simd};

#[cfg(target_arch = "x86_64")]
use crate::simd::{avx2::Avx2, avx512::Avx512};

/// Instructions that a kernel is compiled for. [`InstructionSet::available`] lists those that the processor runs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum InstructionSet {
    /// The baseline of the compiler's target.
    Portable,
    /// x86-64 with AVX2 and FMA.
    Avx2,
    /// x86-64 with AVX-512 F, VL, BW and DQ.
    Avx512,
    /// The same and AVX-512 BF16.
    Avx512Bf16,
}

/// An invalid value of [`InstructionSet::VARIABLE`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct InstructionSetError {
    /// The value found.
    pub text: String,
    /// Whether the value is the name of an instruction set that this processor lacks.
    pub is_known: bool,
}

impl fmt::Display for InstructionSetError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let names = InstructionSet::available().map(InstructionSet::name).collect::<Vec<_>>().join(", ");
        let reason = if self.is_known { "not supported by this processor" } else { "unknown instruction set" };
        write!(f, "{reason}; use one of {names}, or unset the variable for the first of them")
    }
}

impl std::error::Error for InstructionSetError {}

/// A computation that is generic over the instruction set. `run` must be `#[inline(always)]`.
pub(crate) trait Kernel {
    type Output;
    fn run<S: Simd>(self, simd: S) -> Self::Output;
}

/// Type of the operands of matrix products; sums are f32.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OperandType {
    /// f32, as they are.
    F32,
    /// Rounded to bf16. Fast where [`InstructionSet::has_bf16`].
    Bf16,
}

/// A [`Kernel`] that is generic over the operands of its products too.
pub(crate) trait ProductKernel {
    type Output;
    fn run<S: Simd, O: Operands>(self, simd: S) -> Self::Output;
}

struct WithOperands<K, O>(K, PhantomData<O>);

impl<K: ProductKernel, O: Operands> Kernel for WithOperands<K, O> {
    type Output = K::Output;

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> K::Output {
        self.0.run::<S, O>(simd)
    }
}

impl InstructionSet {
    /// All instruction sets, widest first.
    pub const ALL: [Self; 4] = [Self::Avx512Bf16, Self::Avx512, Self::Avx2, Self::Portable];

    /// Environment variable that forces an instruction set: `avx512-bf16`, `avx512`, `avx2` or `portable`.
    pub const VARIABLE: &str = "CLIFT_INSTRUCTION_SET";

    /// Returns the set that [`InstructionSet::VARIABLE`] forces, or else the widest available. The variable is read once
    /// per process. An invalid value is ignored here; programs report it by calling [`InstructionSet::forced`] at start.
    pub fn detected() -> Self {
        static DETECTED: OnceLock<InstructionSet> = OnceLock::new();
        *DETECTED.get_or_init(|| Self::forced().ok().flatten().unwrap_or_else(Self::widest))
    }

    /// Returns the widest set that this processor runs.
    pub fn widest() -> Self {
        Self::available().next().unwrap_or(Self::Portable)
    }

    /// Returns the set that [`InstructionSet::VARIABLE`] forces; `None` if the variable is unset or empty.
    ///
    /// # Errors
    /// [`InstructionSetError`] if the value is not the name of an available instruction set.
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

    /// Iterates over the sets that this processor runs, widest first.
    pub fn available() -> impl Iterator<Item = Self> {
        Self::ALL.into_iter().filter(|set| set.is_available())
    }

    /// Returns the name in lower case.
    pub fn name(self) -> &'static str {
        match self {
            Self::Portable => "portable",
            Self::Avx2 => "avx2",
            Self::Avx512 => "avx512",
            Self::Avx512Bf16 => "avx512-bf16",
        }
    }

    fn is_available(self) -> bool {
        match self {
            Self::Portable => true,
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma"),
            #[cfg(target_arch = "x86_64")]
            Self::Avx512 => {
                is_x86_feature_detected!("avx512f")
                    && is_x86_feature_detected!("avx512vl")
                    && is_x86_feature_detected!("avx512bw")
                    && is_x86_feature_detected!("avx512dq")
                    && Self::Avx2.is_available()
            }
            #[cfg(target_arch = "x86_64")]
            Self::Avx512Bf16 => is_x86_feature_detected!("avx512bf16") && Self::Avx512.is_available(),
            #[cfg(not(target_arch = "x86_64"))]
            Self::Avx2 | Self::Avx512 | Self::Avx512Bf16 => false,
        }
    }

    /// Whether the set has instructions for products of bf16 values; the others emulate them, many times slower than f32.
    pub fn has_bf16(self) -> bool {
        self == Self::Avx512Bf16
    }

    /// Runs a kernel compiled for this instruction set and these operands, on this thread.
    ///
    /// # Panics
    /// As [`InstructionSet::run`].
    pub(crate) fn run_product<K: ProductKernel>(self, operands: OperandType, kernel: K) -> K::Output {
        match operands {
            OperandType::F32 => self.run(WithOperands::<K, F32>(kernel, PhantomData)),
            OperandType::Bf16 => self.run(WithOperands::<K, Bf16>(kernel, PhantomData)),
        }
    }

    /// Runs a kernel compiled for this instruction set, on this thread.
    ///
    /// # Panics
    /// If the processor lacks it.
    pub(crate) fn run<K: Kernel>(self, kernel: K) -> K::Output {
        assert!(self.is_available(), "this processor lacks {}", self.name());
        match self {
            Self::Portable => kernel.run(Portable),
            // SAFETY: checked above.
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => unsafe { run_avx2(kernel) },
            // SAFETY: checked above.
            #[cfg(target_arch = "x86_64")]
            Self::Avx512 => unsafe { run_avx512(kernel) },
            // SAFETY: checked above.
            #[cfg(target_arch = "x86_64")]
            Self::Avx512Bf16 => unsafe { run_avx512_bf16(kernel) },
            #[cfg(not(target_arch = "x86_64"))]
            Self::Avx2 | Self::Avx512 | Self::Avx512Bf16 => unreachable!("not available"),
        }
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn run_avx2<K: Kernel>(kernel: K) -> K::Output {
    // SAFETY: this function is only called on a processor with these instructions.
    kernel.run(unsafe { Avx2::new() })
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512vl,avx512bw,avx512dq,avx2,fma")]
fn run_avx512<K: Kernel>(kernel: K) -> K::Output {
    // SAFETY: this function is only called on a processor with these instructions.
    kernel.run(unsafe { Avx512::<false>::new() })
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512bf16,avx512f,avx512vl,avx512bw,avx512dq,avx2,fma")]
fn run_avx512_bf16<K: Kernel>(kernel: K) -> K::Output {
    // SAFETY: this function is only called on a processor with these instructions.
    kernel.run(unsafe { Avx512::<true>::new() })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_available_sets_parse_and_others_are_refused() {
        assert_eq!(InstructionSet::parse(""), Ok(None));
        assert_eq!(InstructionSet::parse("portable"), Ok(Some(InstructionSet::Portable)));
        for set in InstructionSet::ALL {
            assert_eq!(InstructionSet::parse(set.name()).is_ok(), set.is_available(), "{}", set.name());
        }
        let message = InstructionSet::parse("AVX2").unwrap_err().to_string();
        assert!(message.starts_with("unknown instruction set; use one of "), "{message}");
        assert!(message.contains("portable"), "{message}");
    }
}
