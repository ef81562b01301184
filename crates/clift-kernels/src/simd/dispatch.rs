//! The choice of the instruction set, and running a kernel with it.

use std::sync::OnceLock;

use crate::simd::portable::Portable;
use crate::simd::vector::{Bf16, F32, Operands, Simd};

#[cfg(target_arch = "x86_64")]
use crate::simd::amx::{self, Tiles};
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
    /// The same and AMX for products of bf16 values, on Linux.
    Amx,
}

/// Type of the operands of matrix products; sums are f32.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OperandType {
    /// f32, as they are.
    F32,
    /// Rounded to bf16. Fast where [`InstructionSet::has_bf16`].
    Bf16,
}

/// A computation that is generic over the instruction set and the operands of its products. `run` must be
/// `#[inline(always)]`.
pub(crate) trait Kernel {
    fn run<S: Simd, O: Operands>(self, simd: S);
}

impl InstructionSet {
    /// Returns the widest set that this processor runs.
    pub fn detected() -> Self {
        static DETECTED: OnceLock<InstructionSet> = OnceLock::new();
        *DETECTED.get_or_init(|| Self::available().next().unwrap_or(Self::Portable))
    }

    /// Iterates over the sets that this processor runs, widest first.
    pub fn available() -> impl Iterator<Item = Self> {
        [Self::Amx, Self::Avx512Bf16, Self::Avx512, Self::Avx2, Self::Portable]
            .into_iter()
            .filter(|set| set.is_available())
    }

    /// Returns the name in lower case.
    pub fn name(self) -> &'static str {
        match self {
            Self::Portable => "portable",
            Self::Avx2 => "avx2",
            Self::Avx512 => "avx512",
            Self::Avx512Bf16 => "avx512-bf16",
            Self::Amx => "amx",
        }
    }

    #[cfg(target_arch = "x86_64")]
    fn is_available(self) -> bool {
        let avx2 = || is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma");
        let avx512 = || {
            is_x86_feature_detected!("avx512f")
                && is_x86_feature_detected!("avx512vl")
                && is_x86_feature_detected!("avx512bw")
                && is_x86_feature_detected!("avx512dq")
                && avx2()
        };
        let bf16 = || is_x86_feature_detected!("avx512bf16") && avx512();
        match self {
            Self::Portable => true,
            Self::Avx2 => avx2(),
            Self::Avx512 => avx512(),
            Self::Avx512Bf16 => bf16(),
            Self::Amx => {
                static HAS_TILES: OnceLock<bool> = OnceLock::new();
                bf16() && *HAS_TILES.get_or_init(amx::is_available)
            }
        }
    }

    #[cfg(not(target_arch = "x86_64"))]
    fn is_available(self) -> bool {
        self == Self::Portable
    }

    /// Whether the set has instructions for products of bf16 values; the others emulate them, many times slower than f32.
    pub fn has_bf16(self) -> bool {
        matches!(self, Self::Avx512Bf16 | Self::Amx)
    }

    /// Runs a kernel compiled for this instruction set, which the processor must have, on this thread.
    pub(crate) fn run(self, kernel: impl Kernel) {
        self.run_with::<F32>(kernel);
    }

    /// [Runs](Self::run) a kernel compiled for the operands of its products, too.
    pub(crate) fn run_product(self, operands: OperandType, kernel: impl Kernel) {
        match operands {
            OperandType::F32 => self.run_with::<F32>(kernel),
            OperandType::Bf16 => self.run_with::<Bf16>(kernel),
        }
    }

    fn run_with<O: Operands>(self, kernel: impl Kernel) {
        assert!(self.is_available(), "this processor lacks {}", self.name());
        // SAFETY: checked above.
        #[cfg(target_arch = "x86_64")]
        unsafe {
            match self {
                Self::Portable => kernel.run::<_, O>(Portable),
                Self::Avx2 => run_avx2::<O>(kernel),
                Self::Avx512 => run_avx512::<O>(kernel),
                Self::Amx if O::PER_LANE > 1 => {
                    let _tiles = Tiles::configure();
                    run_avx512_bf16::<true, O>(kernel);
                }
                Self::Avx512Bf16 | Self::Amx => run_avx512_bf16::<false, O>(kernel),
            }
        }
        #[cfg(not(target_arch = "x86_64"))]
        kernel.run::<_, O>(Portable);
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn run_avx2<O: Operands>(kernel: impl Kernel) {
    // SAFETY: this function is only called on a processor with these instructions.
    kernel.run::<_, O>(unsafe { Avx2::new() });
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512vl,avx512bw,avx512dq,avx2,fma")]
fn run_avx512<O: Operands>(kernel: impl Kernel) {
    // SAFETY: this function is only called on a processor with these instructions.
    kernel.run::<_, O>(unsafe { Avx512::<false, false>::new() });
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512bf16,avx512f,avx512vl,avx512bw,avx512dq,avx2,fma")]
fn run_avx512_bf16<const AMX: bool, O: Operands>(kernel: impl Kernel) {
    // SAFETY: this function is only called on a processor with these instructions, with `AMX` after the tiles were configured.
    kernel.run::<_, O>(unsafe { Avx512::<true, AMX>::new() });
}
