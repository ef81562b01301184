//! Descriptors of corners: upright histograms of gradient directions in 4 x 4 cells, as in SIFT.

use crate::tools::features::gray_image::GrayImage;

/// Cells along a side.
const CELLS: usize = 4;
/// Directions per cell.
const DIRECTIONS: usize = 8;
/// Side of a cell in pixels.
const CELL_PX: f32 = 5.0;
/// Largest component relative to the length. Clipping keeps one strong edge from dominating.
const MAX_COMPONENT: f32 = 0.2;
/// Length of a descriptor; components are integers.
const LENGTH: f32 = 1024.0;

/// A vector of length 1,024, up to rounding.
#[derive(Clone, Debug)]
pub(crate) struct Descriptor {
    values: [i16; CELLS * CELLS * DIRECTIONS],
    /// Squared length.
    square: i32,
}

impl Descriptor {
    /// Describes the surroundings of (x, y), in pixels. Returns `None` near the edge and for a constant surrounding.
    pub fn at(gray: &GrayImage, x: f64, y: f64) -> Option<Self> {
        let half = (CELLS as f32 * CELL_PX / 2.0) as i64 + 1;
        let (column, row) = (x.floor() as i64, y.floor() as i64);
        let inside = |position: i64, size: usize| position - half >= 1 && position + half < size as i64 - 1;
        if !inside(column, gray.width) || !inside(row, gray.height) {
            return None;
        }
        let mut sums = [0.0_f32; CELLS * CELLS * DIRECTIONS];
        for v in row - half..=row + half {
            for u in column - half..=column + half {
                let [dx, dy] = gray.gradient(u as usize, v as usize);
                // Position in cells, 0 at the centre of the first cell.
                let across = ((u as f64 + 0.5 - x) as f32) / CELL_PX + (CELLS as f32 - 1.0) / 2.0;
                let down = ((v as f64 + 0.5 - y) as f32) / CELL_PX + (CELLS as f32 - 1.0) / 2.0;
                let turn = (dy.atan2(dx) / std::f32::consts::TAU).rem_euclid(1.0) * DIRECTIONS as f32;
                add(&mut sums, [across, down, turn], (dx * dx + dy * dy).sqrt());
            }
        }
        let length = |values: &[f32]| values.iter().map(|value| value * value).sum::<f32>().sqrt();
        let whole = length(&sums);
        if whole < 1e-3 {
            return None;
        }
        for value in &mut sums {
            *value = (*value / whole).min(MAX_COMPONENT);
        }
        let cut = length(&sums);
        let values = sums.map(|value| (value / cut * LENGTH).round() as i16);
        let square = values.iter().map(|value| i32::from(*value) * i32::from(*value)).sum();
        Some(Self { values, square })
    }

    pub fn squared_distance(&self, other: &Self) -> i32 {
        let product: i32 = self.values.iter().zip(&other.values).map(|(a, b)| i32::from(*a) * i32::from(*b)).sum();
        self.square + other.square - 2 * product
    }
}

/// Distributes a gradient over the neighbouring cells and directions with linear weights.
fn add(sums: &mut [f32], [across, down, turn]: [f32; 3], strength: f32) {
    let parts = |position: f32| {
        let low = position.floor();
        [(low as i64, 1.0 - (position - low)), (low as i64 + 1, position - low)]
    };
    for (row, by_row) in parts(down) {
        for (column, by_column) in parts(across) {
            if !(0..CELLS as i64).contains(&row) || !(0..CELLS as i64).contains(&column) {
                continue;
            }
            let cell = (row as usize * CELLS + column as usize) * DIRECTIONS;
            for (direction, by_direction) in parts(turn) {
                sums[cell + direction as usize % DIRECTIONS] += strength * by_row * by_column * by_direction;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clift_core::RgbImage;

    fn waves(shift: f64, contrast: f64) -> GrayImage {
        let (width, height) = (64, 64);
        let value = |x: usize, y: usize| {
            let (x, y) = (x as f64 - shift, y as f64);
            (127.0 + contrast * ((x * 0.4).sin() + (y * 0.3 + x * 0.1).cos())) as u8
        };
        let rgb = (0..height).flat_map(|y| (0..width).flat_map(move |x| [value(x, y); 3])).collect();
        GrayImage::new(&RgbImage { width, height, rgb }).blurred()
    }

    #[test]
    fn descriptor_moves_with_the_image_and_ignores_contrast() {
        let here = Descriptor::at(&waves(0.0, 60.0), 30.5, 30.5).unwrap();
        let moved = Descriptor::at(&waves(3.0, 60.0), 33.5, 30.5).unwrap();
        let faint = Descriptor::at(&waves(0.0, 30.0), 30.5, 30.5).unwrap();
        let elsewhere = Descriptor::at(&waves(0.0, 60.0), 38.5, 25.5).unwrap();
        assert_eq!(here.squared_distance(&here), 0);
        let far = here.squared_distance(&elsewhere);
        for same in [moved, faint] {
            assert!(here.squared_distance(&same) * 20 < far, "{} {far}", here.squared_distance(&same));
        }
    }

    #[test]
    fn edges_and_plain_walls_have_no_descriptor() {
        assert!(Descriptor::at(&waves(0.0, 60.0), 8.0, 30.0).is_none());
        let plain = GrayImage { width: 64, height: 64, values: vec![7.0; 64 * 64] };
        assert!(Descriptor::at(&plain, 30.0, 30.0).is_none());
    }
}
