//! Gray images in f32.

use crate::image::rgb_image::RgbImage;

/// Brightness in `[0, 255]`, row-major.
pub(crate) struct GrayImage {
    pub width: usize,
    pub height: usize,
    pub values: Vec<f32>,
}

impl GrayImage {
    /// The mean of the channels, green twice: near the perceived brightness.
    pub fn new(image: &RgbImage) -> Self {
        let values = image.rgb.as_chunks::<3>().0.iter().map(|[r, g, b]| {
            let sum = u16::from(*r) + 2 * u16::from(*g) + u16::from(*b);
            f32::from(sum) / 4.0
        });
        Self { width: image.width, height: image.height, values: values.collect() }
    }

    /// Smooths by a binomial filter (1 4 6 4 1): a Gaussian of one pixel.
    pub fn blurred(&self) -> Self {
        let Self { width, height, values } = self;
        let (width, height) = (*width, *height);
        let at = |place: usize, offset: usize, size: usize| (place + offset).saturating_sub(2).min(size - 1);
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

    /// Half the difference of the neighbours, across and down; the pixel must not be at the edge.
    pub fn gradient(&self, x: usize, y: usize) -> [f32; 2] {
        let at = y * self.width + x;
        let v = &self.values;
        [(v[at + 1] - v[at - 1]) / 2.0, (v[at + self.width] - v[at - self.width]) / 2.0]
    }
}
