//! Writes a sheet of synthetic frames, one scene a cell.
//!
//!     cargo run --release -p clift-data --example synthetic_sheet -- OUT.png

use std::error::Error;

use clift_core::RgbImage;
use clift_data::{Look, SceneSource, SyntheticConfig, SyntheticSource, encode_png};

/// Cells along each side of the sheet.
const CELLS: usize = 8;
/// Pixels along each side of a cell.
const SIZE: usize = 64;
const FRAMES: usize = 32;

fn main() -> Result<(), Box<dyn Error>> {
    let out = std::env::args().nth(1).ok_or("usage: synthetic_sheet OUT.png")?;
    let real = SyntheticSource::new(SyntheticConfig {
        look: Look::Real,
        num_scenes: CELLS * CELLS,
        num_frames: FRAMES,
        width: SIZE,
        height: SIZE,
        ..Default::default()
    })?;
    let width = CELLS * SIZE;
    let mut rgb = vec![0; width * width * 3];
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
    Ok(())
}
