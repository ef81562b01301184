//! Random inputs that host and device know, and reads of parts of results.

use std::cell::OnceCell;

use clift_cube::{Buffer, Values};
use cubecl::prelude::Client;
use half::f16;

/// Values that a thread makes.
const PART: usize = 1 << 21;

/// Random values in [-scale, scale].
#[derive(Clone, Copy)]
struct Random {
    seed: u64,
    scale: f32,
    /// Rounds values to f16.
    is_rounded: bool,
}

impl Random {
    fn at(self, i: usize) -> f32 {
        let value = self.scale * ((hash(self.seed, i) >> 40) as f32 / (1 << 23) as f32 - 1.0);
        if self.is_rounded { f16::from_f32(value).to_f32() } else { value }
    }
}

/// Random values, and their buffer once it is used.
pub struct Input {
    random: Random,
    len: usize,
    values: Values,
    buffer: OnceCell<Buffer>,
}

impl Input {
    pub fn new(seed: u64, len: usize) -> Self {
        let random = Random { seed, scale: 1.0, is_rounded: false };
        Self { random, len, values: Values::F32, buffer: OnceCell::new() }
    }

    pub fn scaled(self, scale: f32) -> Self {
        Self { random: Random { scale, ..self.random }, ..self }
    }

    /// Rounds values to f16, in a buffer of type `values`.
    pub fn rounded(self, values: Values) -> Self {
        Self { random: Random { is_rounded: true, ..self.random }, values, ..self }
    }

    pub fn at(&self, i: usize) -> f64 {
        f64::from(self.random.at(i))
    }

    /// Returns `len` values from `start`.
    pub fn line(&self, start: usize, len: usize) -> Vec<f64> {
        (start..start + len).map(|i| self.at(i)).collect()
    }

    pub fn buffer(&self, client: &Client) -> &Buffer {
        self.buffer.get_or_init(|| {
            let &Self { random, len, values, .. } = self;
            let width = if values == Values::F32 { 4 } else { 2 };
            let mut bytes = vec![0; len * width];
            std::thread::scope(|scope| {
                for (part, bytes) in bytes.chunks_mut(PART * width).enumerate() {
                    scope.spawn(move || {
                        for (i, bytes) in bytes.chunks_exact_mut(width).enumerate() {
                            let value = random.at(part * PART + i);
                            match values {
                                Values::F32 => bytes.copy_from_slice(&value.to_le_bytes()),
                                Values::F16 => bytes.copy_from_slice(&f16::from_f32(value).to_le_bytes()),
                            }
                        }
                    });
                }
            });
            Buffer { handle: client.create_from_slice(&bytes), len, values }
        })
    }
}

/// Returns 64 random bits.
pub fn hash(seed: u64, i: usize) -> u64 {
    let mut x = (i as u64).wrapping_add(seed << 40).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    x = (x ^ (x >> 32)).wrapping_mul(0xd6e8_feb8_6659_fd93);
    x ^ (x >> 32)
}

/// Copies `len` values from `start` of a buffer to the host. The error of a refused launch appears here.
pub fn read(client: &Client, buffer: &Buffer, start: usize, len: usize) -> Result<Vec<f64>, String> {
    let width = if buffer.values == Values::F32 { 4 } else { 2 };
    let end = buffer.handle.size() - ((start + len) * width) as u64;
    let handle = buffer.handle.clone().offset_start((start * width) as u64).offset_end(end);
    let bytes = client.read_one(handle).map_err(|error| error.to_string())?;
    Ok(match buffer.values {
        Values::F32 => bytes.chunks_exact(4).map(|b| f64::from(f32::from_le_bytes([b[0], b[1], b[2], b[3]]))).collect(),
        Values::F16 => bytes.chunks_exact(2).map(|b| f16::from_le_bytes([b[0], b[1]]).to_f64()).collect(),
    })
}

/// Returns `count` indices below `len`, the first and the last among them.
pub fn samples(len: usize, count: usize) -> Vec<usize> {
    let mut all: Vec<usize> = (0..count).map(|i| i * (len - 1) / (count - 1).max(1)).collect();
    all.dedup();
    all
}
