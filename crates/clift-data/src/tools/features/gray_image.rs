//! Gray images in f32: blur and gradients.

use clift_core::RgbImage;

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
