use std::sync::OnceLock;

#[cfg(target_arch = "x86_64")]
use crate::simd::{Avx2, Avx512};
use crate::simd::{Portable, Simd};

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

    /// The one to use: the widest that the processor has, or what [`InstructionSet::VARIABLE`] names,
    /// if the processor has that; any other text is as none. Read once per process.
    pub fn detected() -> Self {
        static DETECTED: OnceLock<InstructionSet> = OnceLock::new();
        *DETECTED.get_or_init(|| {
            let asked = std::env::var(Self::VARIABLE).ok();
            let mut available = Self::available();
            let widest = available.next().unwrap_or(Self::Portable);
            let forced = Self::available().find(|set| asked.as_deref() == Some(set.name()));
            forced.unwrap_or(widest)
        })
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
