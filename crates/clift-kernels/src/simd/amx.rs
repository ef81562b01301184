//! AMX: products of tiles of 16 x 16 pairs of bf16 values.

use std::arch::asm;

use crate::simd::vector::{MATRIX_LANES, Tile};

/// Asks the system for the use of the tile registers; returns whether this process may use them.
#[cfg(target_os = "linux")]
pub fn is_available() -> bool {
    // From `asm/prctl.h` and the list of extended states of the processor.
    const ARCH_REQ_XCOMP_PERM: libc::c_long = 0x1023;
    const XFEATURE_XTILEDATA: libc::c_long = 18;
    let features = std::arch::x86_64::__cpuid_count(7, 0).edx;
    let has_tiles = features & (1 << 22) != 0 && features & (1 << 24) != 0;
    // SAFETY: the call reads its arguments, which are numbers.
    has_tiles && unsafe { libc::syscall(libc::SYS_arch_prctl, ARCH_REQ_XCOMP_PERM, XFEATURE_XTILEDATA) } == 0
}

/// Only Linux is asked.
#[cfg(not(target_os = "linux"))]
pub fn is_available() -> bool {
    false
}

/// The tile registers of this thread, eight tiles of 16 rows of 64 bytes, until it is dropped.
pub struct Tiles(());

#[repr(C, align(64))]
struct Configuration {
    palette: u8,
    start_row: u8,
    reserved: [u8; 14],
    bytes_per_row: [u16; 16],
    rows: [u8; 16],
}

impl Tiles {
    /// # Safety
    /// [`is_available`] has returned true.
    pub unsafe fn configure() -> Self {
        let mut configuration =
            Configuration { palette: 1, start_row: 0, reserved: [0; 14], bytes_per_row: [0; 16], rows: [0; 16] };
        configuration.bytes_per_row[..8].fill(64);
        configuration.rows[..8].fill(16);
        // SAFETY: by the caller's promise; the configuration is one of the processor's palette 1.
        unsafe { asm!("ldtilecfg [{}]", in(reg) &raw const configuration, options(nostack, preserves_flags)) };
        Self(())
    }
}

impl Drop for Tiles {
    fn drop(&mut self) {
        // SAFETY: a value exists only where the tiles were configured.
        unsafe { asm!("tilerelease", options(nostack, preserves_flags)) };
    }
}

/// Computes a tile as [`multiply_tile`](crate::simd::vector::Simd::multiply_tile).
///
/// # Safety
/// The tiles of this thread must be configured. All values of A, B and C in the range of the sizes must be readable, those of C
/// writable.
pub unsafe fn multiply_tile(tile: Tile) {
    debug_assert!(tile.a_step == 1 && tile.inner.is_multiple_of(MATRIX_LANES) && tile.inner > 0, "whole tiles");
    // SAFETY: by the caller's promise. The registers are written before they are read.
    unsafe {
        asm!(
            "tilezero tmm0",
            "tilezero tmm1",
            "tilezero tmm2",
            "tilezero tmm3",
            "test {accumulate}, {accumulate}",
            "jz 2f",
            "tileloadd tmm0, [{c} + {c_row}]",
            "tileloadd tmm1, [{c} + {c_row} + 64]",
            "tileloadd tmm2, [{c_low} + {c_row}]",
            "tileloadd tmm3, [{c_low} + {c_row} + 64]",
            "2:",
            "tileloadd tmm4, [{a} + {a_row}]",
            "tileloadd tmm6, [{b} + {b_step}]",
            "tdpbf16ps tmm0, tmm4, tmm6",
            "tileloadd tmm7, [{b} + {b_step} + 64]",
            "tdpbf16ps tmm1, tmm4, tmm7",
            "tileloadd tmm5, [{a_low} + {a_row}]",
            "tdpbf16ps tmm2, tmm5, tmm6",
            "tdpbf16ps tmm3, tmm5, tmm7",
            "add {a}, 64",
            "add {a_low}, 64",
            "add {b}, {b_next}",
            "dec {count}",
            "jnz 2b",
            "tilestored [{c} + {c_row}], tmm0",
            "tilestored [{c} + {c_row} + 64], tmm1",
            "tilestored [{c_low} + {c_row}], tmm2",
            "tilestored [{c_low} + {c_row} + 64], tmm3",
            accumulate = in(reg) u64::from(tile.accumulate),
            a = inout(reg) tile.a => _,
            a_low = inout(reg) tile.a.add(16 * tile.a_row) => _,
            a_row = in(reg) 4 * tile.a_row,
            b = inout(reg) tile.b => _,
            b_step = in(reg) 4 * tile.b_step,
            b_next = in(reg) 4 * tile.b_step * MATRIX_LANES,
            c = in(reg) tile.c,
            c_low = in(reg) tile.c.add(16 * tile.c_row),
            c_row = in(reg) 4 * tile.c_row,
            count = inout(reg) tile.inner / MATRIX_LANES => _,
            out("tmm0") _, out("tmm1") _, out("tmm2") _, out("tmm3") _,
            out("tmm4") _, out("tmm5") _, out("tmm6") _, out("tmm7") _,
            options(nostack),
        );
    }
}
