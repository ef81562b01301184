//! Random inputs that host and device know, and reads of parts of results.

use std::cell::OnceCell;

use clift_cube::{Buffer, Values};
use cubecl::prelude::Client;
use half::f16;

/// A buffer of values in [-scale, scale], uploaded when it is first used.
pub struct Input {
    seed: u64,
    len: usize,
    scale: f32,
    /// Type of the buffer.
    pub values: Values,
    /// Rounds values to f16, whatever the type of the buffer.
    is_rounded: bool,
    buffer: OnceCell<Buffer>,
}

impl Input {
    pub fn new(seed: u64, len: usize) -> Self {
        Self { seed, len, scale: 1.0, values: Values::F32, is_rounded: false, buffer: OnceCell::new() }
    }

    pub fn scaled(self, scale: f32) -> Self {
        Self { scale, ..self }
    }

    /// Rounds values to f16, in a buffer of type `values`.
    pub fn rounded(self, values: Values) -> Self {
        Self { values, is_rounded: true, ..self }
    }

    fn value(&self, i: usize) -> f32 {
        let value = self.scale * ((hash(self.seed, i) >> 40) as f32 / (1 << 23) as f32 - 1.0);
        if self.is_rounded { f16::from_f32(value).to_f32() } else { value }
    }

    pub fn at(&self, i: usize) -> f64 {
        f64::from(self.value(i))
    }

    /// Returns `len` values from `start`.
    pub fn line(&self, start: usize, len: usize) -> Vec<f64> {
        (start..start + len).map(|i| self.at(i)).collect()
    }

    pub fn buffer(&self, client: &Client) -> &Buffer {
        self.buffer.get_or_init(|| {
            let values = (0..self.len).map(|i| self.value(i));
            let bytes: Vec<u8> = match self.values {
                Values::F32 => values.flat_map(f32::to_le_bytes).collect(),
                Values::F16 => values.flat_map(|x| f16::from_f32(x).to_le_bytes()).collect(),
            };
            Buffer { handle: client.create_from_slice(&bytes), len: self.len, values: self.values }
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
