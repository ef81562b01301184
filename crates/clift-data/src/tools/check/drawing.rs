//! An image of two frames side by side with matched corners and their epipolar lines.

use clift_core::RgbImage;
use glam::DMat3;

use crate::tools::check::matches::subsample;
use crate::tools::features::epipolar::{Correspondence, WIDTH, line, line_back};
use crate::tools::features::image_features::reduced;

const NUM_PLOTTED: usize = 12;
/// Columns between the frames.
const GAP: usize = 12;
/// Radius of a dot in pixels.
const DOT: f64 = 4.5;
/// Half the width of a line in pixels.
const LINE: f64 = 0.9;

/// Plots some matches: a dot per corner, and in the same colour the epipolar line of the matching corner.
pub(crate) fn epipolar_image(frames: &[RgbImage; 2], geometry: &DMat3, matches: &[Correspondence]) -> RgbImage {
    let frames = [reduced(&frames[0]), reduced(&frames[1])];
    let height = frames[0].height.max(frames[1].height);
    let width = frames[0].width + GAP + frames[1].width;
    let mut canvas = RgbImage { width, height, rgb: vec![255; width * height * 3] };
    let left = [0, frames[0].width + GAP];
    for (frame, left) in frames.iter().zip(left) {
        for (row, pixels) in frame.rgb.chunks_exact(frame.width * 3).enumerate() {
            let at = (row * width + left) * 3;
            canvas.rgb[at..at + pixels.len()].copy_from_slice(pixels);
        }
    }
    let mut sorted = matches.to_vec();
    sorted.sort_by(|a, b| a.first[0].total_cmp(&b.first[0]));
    let plotted: Vec<Correspondence> = subsample(&sorted, NUM_PLOTTED).collect();
    for (i, pair) in plotted.iter().enumerate() {
        let colour = colour(i, plotted.len());
        let sides = [(pair.first, line_back(geometry, pair.second)), (pair.second, line(geometry, pair.first))];
        for ((point, line), (frame, left)) in sides.into_iter().zip(frames.iter().zip(left)) {
            // Matches are in pixels of an image WIDTH wide.
            let unit = frame.width as f64 / WIDTH as f64;
            let mut paint = |distance: &dyn Fn(f64, f64) -> f64, colour: [u8; 3]| {
                for y in 0..frame.height {
                    for x in 0..frame.width {
                        let share = (0.5 - distance(x as f64 + 0.5, y as f64 + 0.5)).clamp(0.0, 1.0);
                        if share > 0.0 {
                            let at = (y * width + left + x) * 3;
                            blend(&mut canvas.rgb[at..at + 3], colour, share);
                        }
                    }
                }
            };
            if let Some(line) = line {
                let away = |x: f64, y: f64| (line.x * x + line.y * y + line.z * unit).abs();
                paint(&|x, y| away(x, y) - LINE - 0.8, [0; 3]);
                paint(&|x, y| away(x, y) - LINE, colour);
            }
            let [u, v] = point.map(|value| value * unit);
            paint(&|x, y| (x - u).hypot(y - v) - DOT - 1.5, [255; 3]);
            paint(&|x, y| (x - u).hypot(y - v) - DOT, colour);
        }
    }
    canvas
}

/// Returns a colour of the hue wheel; consecutive colours are far apart.
fn colour(index: usize, count: usize) -> [u8; 3] {
    let hue = (index * 5 % count.max(1)) as f64 / count.max(1) as f64 * 6.0;
    [5.0, 3.0, 1.0].map(|offset| {
        let k = (offset + hue) % 6.0;
        (255.0 * (1.0 - k.min(4.0 - k).clamp(0.0, 1.0))) as u8
    })
}

fn blend(pixel: &mut [u8], colour: [u8; 3], share: f64) {
    for (value, wanted) in pixel.iter_mut().zip(colour) {
        *value = (f64::from(*value) * (1.0 - share) + f64::from(wanted) * share).round() as u8;
    }
}

#[cfg(test)]
mod tests {

    use super::*;

    #[test]
    fn epipolar_line_passes_the_matching_corner() {
        // A sideways motion: epipolar lines are rows.
        let geometry = DMat3::from_rows_array(&[0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0]);
        let frames = [(); 2].map(|()| RgbImage { width: 160, height: 90, rgb: vec![128; 160 * 90 * 3] });
        let pair = Correspondence { first: [200.0, 102.0], second: [400.0, 102.0] };
        let canvas = epipolar_image(&frames, &geometry, &[pair]);
        assert_eq!((canvas.width, canvas.height), (160 + GAP + 160, 90));
        let pixel = |x: usize, y: usize| &canvas.rgb[(y * canvas.width + x) * 3..][..3];
        let colour = colour(0, 1);
        // Row 102 of 640 columns is the middle of row 25 of 160; the dots are at columns 50 and 100.
        for x in [5, 50, 155, 160 + GAP + 5, 160 + GAP + 100] {
            assert_eq!(pixel(x, 25), colour, "{x}");
        }
        assert_eq!(pixel(5, 40), [128; 3]);
        assert_eq!(pixel(165, 25), [255; 3]);
        assert_ne!(pixel(50, 28), [128; 3], "the dot is thicker than the line");
    }
}
