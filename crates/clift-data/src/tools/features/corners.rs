//! Gray images in f32, and their Shi-Tomasi corners: positions where the image changes in every direction.

use clift_core::RgbImage;

/// Half the side of the window of summed gradients, in pixels.
const REACH: usize = 2;
const APART: usize = 4;
/// Smallest distance from the edge, in pixels: nearer corners have no descriptor.
const MARGIN: usize = 12;
/// Smallest measure of a corner, in squared gray levels per pixel: above the noise of a JPEG.
const MIN_MEASURE: f32 = 4.0;
/// Approximate number of cells of an image. Each gets the same share of the corners, so that they cover the image.
const CELLS: usize = 96;

/// Finds at most `count` corners as column and row. The centre of the first pixel is at (0.5, 0.5).
pub(crate) fn find_corners(gray: &GrayImage, count: usize) -> Vec<[f64; 2]> {
    let (width, height) = (gray.width, gray.height);
    if width.min(height) <= 2 * MARGIN {
        return Vec::new();
    }
    let measure = measure(gray);
    let at = |x: usize, y: usize| measure[y * width + x];
    let mut corners = Vec::new();
    for y in MARGIN..height - MARGIN {
        for x in MARGIN..width - MARGIN {
            let value = at(x, y);
            // The first of equal neighbours is the corner.
            let is_largest = value > MIN_MEASURE
                && (y - APART..=y + APART).all(|v| {
                    (x - APART..=x + APART).all(|u| {
                        let other = at(u, v);
                        other < value || (other == value && (v, u) >= (y, x))
                    })
                });
            if is_largest {
                corners.push((x, y, value));
            }
        }
    }
    let side = ((width * height) as f64 / CELLS as f64).sqrt().max(1.0);
    let columns = (width as f64 / side).ceil() as usize;
    let cell = |x: usize, y: usize| (y as f64 / side) as usize * columns + (x as f64 / side) as usize;
    // Strongest first; equal ones by position, so that the result does not depend on the sort.
    corners.sort_by(|a, b| b.2.total_cmp(&a.2).then((a.1, a.0).cmp(&(b.1, b.0))));
    let mut taken = vec![0; columns * ((height as f64 / side).ceil() as usize + 1)];
    let most = count.div_ceil(CELLS / 2);
    let kept = corners.into_iter().filter(|(x, y, _)| {
        taken[cell(*x, *y)] += 1;
        taken[cell(*x, *y)] <= most
    });
    let peak = |(x, y, _): (usize, usize, f32)| {
        [
            x as f64 + 0.5 + parabola_peak(at(x - 1, y), at(x, y), at(x + 1, y)),
            y as f64 + 0.5 + parabola_peak(at(x, y - 1), at(x, y), at(x, y + 1)),
        ]
    };
    kept.take(count).map(peak).collect()
}

/// Returns the position of the maximum of the parabola through three neighbouring values, relative to the middle one.
fn parabola_peak(before: f32, middle: f32, after: f32) -> f64 {
    let curvature = before - 2.0 * middle + after;
    if curvature >= 0.0 { 0.0 } else { f64::from((before - after) / (2.0 * curvature)).clamp(-0.5, 0.5) }
}

/// Returns the smaller eigenvalue of the summed products of gradients around every pixel; zero at the edge.
fn measure(gray: &GrayImage) -> Vec<f32> {
    let (width, height) = (gray.width, gray.height);
    let mut products = vec![[0.0_f32; 3]; width * height];
    for y in 1..height - 1 {
        for x in 1..width - 1 {
            let [dx, dy] = gray.gradient(x, y);
            products[y * width + x] = [dx * dx, dx * dy, dy * dy];
        }
    }
    // Binomial weights; a square window prefers the directions of its sides.
    let weights = [1.0, 4.0, 6.0, 4.0, 1.0_f32].map(|weight| weight / 16.0);
    let mut across = vec![[0.0; 3]; width * height];
    for y in 0..height {
        for x in REACH..width - REACH {
            let window = &products[y * width + x - REACH..=y * width + x + REACH];
            let sum = &mut across[y * width + x];
            for (product, weight) in window.iter().zip(weights) {
                (0..3).for_each(|i| sum[i] += product[i] * weight);
            }
        }
    }
    let mut measure = vec![0.0; width * height];
    for y in REACH..height - REACH {
        for x in 0..width {
            let mut sum = [0.0; 3];
            for (offset, weight) in weights.iter().enumerate() {
                let product = across[(y + offset - REACH) * width + x];
                (0..3).for_each(|i| sum[i] += product[i] * weight);
            }
            let [xx, xy, yy] = sum;
            measure[y * width + x] = f32::midpoint(xx, yy) - ((xx - yy) * (xx - yy) / 4.0 + xy * xy).sqrt();
        }
    }
    measure
}

/// Brightness in `[0, 255]`, row-major.
pub(crate) struct GrayImage {
    pub width: usize,
    pub height: usize,
    pub values: Vec<f32>,
}

impl GrayImage {
    /// Converts an image to gray: the mean of the channels with green counted twice.
    pub fn new(image: &RgbImage) -> Self {
        let gray = |[r, g, b]: &[u8; 3]| f32::from(u16::from(*r) + 2 * u16::from(*g) + u16::from(*b)) / 4.0;
        let values = image.rgb.as_chunks::<3>().0.iter().map(gray).collect();
        Self { width: image.width, height: image.height, values }
    }

    /// Smooths the image with a binomial filter (1 4 6 4 1), about a Gaussian of one pixel.
    pub fn blurred(&self) -> Self {
        let Self { width, height, values } = self;
        let (width, height) = (*width, *height);
        let at = |position: usize, offset: usize, size: usize| (position + offset).saturating_sub(2).min(size - 1);
        let weights = [1.0, 4.0, 6.0, 4.0, 1.0_f32].map(|weight| weight / 16.0);
        let mut across = Vec::with_capacity(values.len());
        for row in values.chunks_exact(width) {
            across.extend((0..width).map(|x| {
                weights.iter().enumerate().map(|(offset, weight)| row[at(x, offset, width)] * weight).sum::<f32>()
            }));
        }
        let mut blurred = vec![0.0; values.len()];
        for (y, line) in blurred.chunks_exact_mut(width).enumerate() {
            for (offset, weight) in weights.iter().enumerate() {
                let from = at(y, offset, height) * width;
                for (sum, value) in line.iter_mut().zip(&across[from..from + width]) {
                    *sum += value * weight;
                }
            }
        }
        Self { width, height, values: blurred }
    }

    /// Returns half the difference of the horizontal and of the vertical neighbours of a pixel off the edge.
    pub fn gradient(&self, x: usize, y: usize) -> [f32; 2] {
        let at = y * self.width + x;
        let v = &self.values;
        [(v[at + 1] - v[at - 1]) / 2.0, (v[at + self.width] - v[at - self.width]) / 2.0]
    }
}
