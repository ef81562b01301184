//! Renders a contact sheet of synthetic scenes: a row per scene, with frames spread evenly along the camera path.
//!
//! ```text
//! cargo run --release -p clift-data --example synthetic_sheet -- sheet.png [size] [rows] [columns] [first scene]
//! ```

use std::error::Error;
use std::time::Instant;

use clift_data::{SceneSource, SyntheticConfig, SyntheticSource};

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let path = arguments.next().ok_or("usage: synthetic_sheet OUT.png [size] [rows] [columns] [first scene]")?;
    let numbers = arguments.map(|argument| argument.parse()).collect::<Result<Vec<usize>, _>>()?;
    let number = |index: usize, default: usize| numbers.get(index).copied().unwrap_or(default);
    let (size, rows, columns, first) = (number(0, 256), number(1, 4), number(2, 4), number(3, 0));

    let source = SyntheticSource::new(SyntheticConfig { width: size, height: size, ..Default::default() })?;
    let last_frame = source.config().num_frames - 1;
    let mut sheet = image::RgbImage::new((columns * size) as u32, (rows * size) as u32);
    let start = Instant::now();
    for row in 0..rows {
        for column in 0..columns {
            let frame = source.frame(first + row, column * last_frame / (columns - 1).max(1))?;
            let tile =
                image::RgbImage::from_raw(size as u32, size as u32, frame.rgb).ok_or("a frame has another size")?;
            image::imageops::replace(&mut sheet, &tile, (column * size) as i64, (row * size) as i64);
        }
    }
    let frame_s = start.elapsed().as_secs_f64() / (rows * columns) as f64;
    sheet.save(&path)?;
    println!("{path}: {rows} scenes, {:.2} ms per frame", frame_s * 1e3);
    Ok(())
}
