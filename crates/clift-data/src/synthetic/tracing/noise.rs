//! Cheap hashes, value noise and periodic functions, all filtered by the width of a pixel on the surface.

/// Returns the largest integer that is not above `x`. Baseline x86-64 has no instruction for [`f32::floor`].
pub(crate) fn floor(x: f32) -> i32 {
    let cut = x as i32;
    cut - i32::from(x < cut as f32)
}

/// Hashes a cell of the plane to 32 bits.
pub(crate) fn hash(x: i32, y: i32, seed: u32) -> u32 {
    let mut h = (x as u32).wrapping_mul(0x9e37_79b1) ^ (y as u32).wrapping_mul(0x85eb_ca77) ^ seed;
    h = (h ^ (h >> 15)).wrapping_mul(0x2c1b_3c6d);
    h = (h ^ (h >> 12)).wrapping_mul(0x297a_2d39);
    h ^ (h >> 15)
}

/// Converts the `part`-th byte of a hash to `[0, 1]`.
pub(crate) fn byte(hash: u32, part: u32) -> f32 {
    ((hash >> (8 * part)) & 255) as f32 * (1.0 / 255.0)
}

/// Returns the Hermite step from 0 to 1.
pub(crate) fn smooth(x: f32) -> f32 {
    let x = x.clamp(0.0, 1.0);
    x * x * (3.0 - 2.0 * x)
}

/// Returns the share of a pixel of `width` around 0 that lies below `x`: an edge without steps.
pub(crate) fn edge(x: f32, width: f32) -> f32 {
    (x / width + 0.5).clamp(0.0, 1.0)
}

/// Returns the mean over a pixel of `width` of the wave that is 1 in the first `duty` of every period of 1.
pub(crate) fn pulse(x: f32, duty: f32, width: f32) -> f32 {
    let width = width.max(1e-3);
    let integral = |x: f32| {
        let whole = floor(x) as f32;
        whole * duty + (x - whole).min(duty)
    };
    ((integral(x + 0.5 * width) - integral(x - 0.5 * width)) / width).clamp(0.0, 1.0)
}

/// Returns value noise in `[0, 1]` with cells of size 1.
pub(crate) fn value_noise(x: f32, y: f32, seed: u32) -> f32 {
    let (i, j) = (floor(x), floor(y));
    let (u, v) = (smooth(x - i as f32), smooth(y - j as f32));
    let corner = |i: i32, j: i32| byte(hash(i, j, seed), 1);
    let upper = corner(i, j) + u * (corner(i + 1, j) - corner(i, j));
    let lower = corner(i, j + 1) + u * (corner(i + 1, j + 1) - corner(i, j + 1));
    upper + v * (lower - upper)
}

/// Sums octaves of value noise, in about `[-1, 1]` with mean 0. The first octave has cells of size 1; `gain` scales each
/// further one. Octaves finer than two pixels of `width` fade out.
pub(crate) fn octaves(x: f32, y: f32, seed: u32, gain: f32, width: f32) -> f32 {
    let (mut sum, mut amplitude, mut frequency) = (0.0, 1.0, 1.0);
    for octave in 0..4 {
        let visible = (2.0 - 2.0 * frequency * width).min(1.0);
        if visible <= 0.0 {
            break;
        }
        // Shifted, so that the cells of the octaves do not meet in the origin.
        let shift = 17.3 * octave as f32;
        let noise = value_noise(x * frequency + shift, y * frequency - shift, seed ^ octave);
        sum += visible * amplitude * (2.0 * noise - 1.0);
        amplitude *= gain;
        frequency *= 2.3;
    }
    sum
}
