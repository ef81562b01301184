//! Decodes, rescales and crops images as training does, and writes them as PNG for `scripts/check/check_pillow.py`.
//!
//!     cargo run --release -p clift-data --example fit_frame -- 256x256 IN.jpg OUT.png [IN OUT ..]

use std::error::Error;

use clift_core::IntrinsicsNorm;
use clift_data::{decode_image, encode_png, fit_image};

fn main() -> Result<(), Box<dyn Error>> {
    let mut words = std::env::args().skip(1);
    let size = words.next().ok_or("usage: fit_frame 256x256 IN.jpg OUT.png [IN OUT ..]")?;
    let (width, height) = size.split_once('x').ok_or("the size is not of the form 256x256")?;
    let (width, height) = (width.parse()?, height.parse()?);
    let centred = IntrinsicsNorm { fx: 1.0, fy: 1.0, cx: 0.5, cy: 0.5 };
    while let (Some(from), Some(to)) = (words.next(), words.next()) {
        let frame = decode_image(&std::fs::read(&from)?, &from, 0)?;
        let (fitted, _) = fit_image(&frame, centred, width, height)?;
        std::fs::write(to, encode_png(&fitted)?)?;
    }
    Ok(())
}
