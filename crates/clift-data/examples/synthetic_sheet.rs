//! Writes a sheet of synthetic frames, one scene a cell, and prints what a frame of each look costs on one core.
//!
//!     cargo run --release -p clift-data --example synthetic_sheet -- OUT.png

use std::error::Error;
use std::time::Instant;

use clift_core::RgbImage;
use clift_data::{Look, SceneSource, SyntheticConfig, SyntheticSource, encode_png};

/// Cells along each side of the sheet.
const CELLS: usize = 8;
/// Pixels along each side of a cell.
const SIZE: usize = 64;
const FRAMES: usize = 32;
/// Frames of a scene that the timing reads, as training does.
const TIMED_FRAMES: usize = 8;

fn main() -> Result<(), Box<dyn Error>> {
    let out = std::env::args().nth(1).ok_or("usage: synthetic_sheet OUT.png")?;
    let source = |look, seed| {
        let num_scenes = CELLS * CELLS;
        let config = SyntheticConfig {
            look,
            seed,
            num_scenes,
            num_frames: FRAMES,
            width: SIZE,
            height: SIZE,
            ..Default::default()
        };
        SyntheticSource::new(config)
    };
    let width = CELLS * SIZE;
    let mut rgb = vec![0; width * width * 3];
    let real = source(Look::Real, 0)?;
    for scene in 0..CELLS * CELLS {
        let frame = real.frame(scene, FRAMES / 2)?;
        for (row, line) in frame.rgb.chunks_exact(SIZE * 3).enumerate() {
            let start = (scene / CELLS * SIZE + row) * width + scene % CELLS * SIZE;
            rgb[start * 3..][..SIZE * 3].copy_from_slice(line);
        }
    }
    // 64 levels instead of 256 make the file smaller by a third; at this size the eye does not tell them apart.
    for value in &mut rgb {
        *value = (*value & !3) | 2;
    }
    std::fs::write(&out, encode_png(&RgbImage { width, height: width, rgb })?)?;
    for look in [Look::Rooms, Look::Real] {
        let source = source(look, 1)?;
        let started = Instant::now();
        for (scene, frame) in (0..CELLS * CELLS).flat_map(|scene| (0..TIMED_FRAMES).map(move |frame| (scene, frame))) {
            source.frame(scene, frame * FRAMES / TIMED_FRAMES)?;
        }
        let us = started.elapsed().as_secs_f64() * 1e6 / (CELLS * CELLS * TIMED_FRAMES) as f64;
        println!("{look:?}: {us:.0} us per frame of {SIZE} x {SIZE}, of {TIMED_FRAMES} frames a scene");
    }
    Ok(())
}
