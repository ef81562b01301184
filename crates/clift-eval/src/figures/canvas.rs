//! 8-bit RGB images: pixels, text, error maps, PNG files.

use std::path::Path;

use clift_core::replace_file;
use clift_model::check_images;
use embedded_graphics::mono_font::{MonoFont, MonoTextStyle};
use embedded_graphics::pixelcolor::{Rgb888, RgbColor};
use embedded_graphics::prelude::{DrawTarget, Drawable, OriginDimensions, Pixel, Point, Size};
use embedded_graphics::text::{Baseline, Text};
use image::RgbImage;

use crate::error::EvalError;

/// Mean absolute error over red, green and blue at the brightest colour of [`error_map`].
pub const ERROR_FULL_SCALE: f32 = 0.25;

/// An 8-bit RGB image to paint on.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Canvas {
    rgb: RgbImage,
}

impl Canvas {
    /// Makes an image of one colour.
    pub fn new(width: usize, height: usize, colour: [u8; 3]) -> Self {
        Self { rgb: RgbImage::from_pixel(width as u32, height as u32, image::Rgb(colour)) }
    }

    /// Copies an 8-bit `[height, width, 3]` array.
    pub fn from_rgb8(rgb: &[u8], height: usize, width: usize) -> Result<Self, EvalError> {
        let expected = height * width * 3;
        let image = RgbImage::from_raw(width as u32, height as u32, rgb.to_vec()).filter(|_| rgb.len() == expected);
        let reason = || format!("image sizes differ: expected {expected} values, got {}", rgb.len());
        image.map(|rgb| Self { rgb }).ok_or_else(|| EvalError::BadImage { reason: reason() })
    }

    /// Rounds a `[height, width, 3]` array in [0, 1] to 8 bits; values outside are clamped.
    pub fn from_unit(values: &[f32], height: usize, width: usize) -> Result<Self, EvalError> {
        let rgb: Vec<u8> = values.iter().map(|value| (value.clamp(0.0, 1.0) * 255.0).round() as u8).collect();
        Self::from_rgb8(&rgb, height, width)
    }

    /// Returns the pixels, `[height, width, 3]`.
    pub fn as_rgb8(&self) -> &[u8] {
        self.rgb.as_raw()
    }

    /// Returns the number of columns.
    pub fn width(&self) -> usize {
        self.rgb.width() as usize
    }

    /// Returns the number of rows.
    pub fn height(&self) -> usize {
        self.rgb.height() as usize
    }

    /// Returns the colour of the pixel in column `x` and row `y`.
    pub fn pixel(&self, x: usize, y: usize) -> [u8; 3] {
        self.rgb.get_pixel(x as u32, y as u32).0
    }

    /// Scales the image to fit into `width` by `height` pixels without distortion. Whole factors repeat pixels; for other
    /// factors the next larger magnification is shrunk, which keeps the edges of small images sharp.
    #[must_use]
    pub fn fitted(&self, width: usize, height: usize) -> Self {
        let scale = (width as f64 / self.width() as f64).min(height as f64 / self.height() as f64);
        let factor = (scale.ceil() as u32).max(1);
        let (large_width, large_height) = (self.rgb.width() * factor, self.rgb.height() * factor);
        let large = RgbImage::from_fn(large_width, large_height, |x, y| *self.rgb.get_pixel(x / factor, y / factor));
        let scaled = |size: usize| ((size as f64 * scale).round() as u32).max(1);
        let (width, height) = (scaled(self.width()), scaled(self.height()));
        if (width, height) == large.dimensions() {
            return Self { rgb: large };
        }
        Self { rgb: image::imageops::resize(&large, width, height, image::imageops::FilterType::Triangle) }
    }

    /// Copies `other` to column `x` and row `y` (top left corner), cropped at the border.
    pub fn paste(&mut self, other: &Self, x: usize, y: usize) {
        image::imageops::replace(&mut self.rgb, &other.rgb, x as i64, y as i64);
    }

    /// Writes one line of text at column `x` and row `y` (top left corner). Characters beyond Latin-1 become `?`.
    pub fn write_text(&mut self, text: &str, x: usize, y: usize, font: &MonoFont, colour: [u8; 3]) {
        let style = MonoTextStyle::new(font, Rgb888::new(colour[0], colour[1], colour[2]));
        let Ok(_) = Text::with_baseline(text, Point::new(x as i32, y as i32), style, Baseline::Top).draw(self);
    }

    /// Writes the image as a PNG file, atomically.
    pub fn write_png(&self, path: &Path) -> Result<(), EvalError> {
        let mut png = std::io::Cursor::new(Vec::new());
        let encoded = self.rgb.write_to(&mut png, image::ImageFormat::Png).map_err(std::io::Error::other);
        let written = encoded.and_then(|()| replace_file(path, png.get_ref()));
        written.map_err(EvalError::io("writing the image", path))
    }
}

impl OriginDimensions for Canvas {
    fn size(&self) -> Size {
        Size::new(self.rgb.width(), self.rgb.height())
    }
}

impl DrawTarget for Canvas {
    type Color = Rgb888;
    type Error = std::convert::Infallible;

    fn draw_iter<I: IntoIterator<Item = Pixel<Rgb888>>>(&mut self, pixels: I) -> Result<(), Self::Error> {
        for Pixel(point, colour) in pixels {
            let (x, y) = (point.x as u32, point.y as u32); // a negative coordinate wraps beyond the image
            if let Some(pixel) = self.rgb.get_pixel_mut_checked(x, y) {
                *pixel = image::Rgb([colour.r(), colour.g(), colour.b()]);
            }
        }
        Ok(())
    }
}

/// Makes an image of the mean absolute error over red, green and blue, from black at 0
/// over red and yellow to white at [`ERROR_FULL_SCALE`]. Refuses a NaN or an infinity, which would look like no error.
pub fn error_map(pred: &[f32], target: &[f32], height: usize, width: usize) -> Result<Canvas, EvalError> {
    check_images(pred, target, height * width * 3)?;
    let colours: Vec<u8> = pred
        .as_chunks::<3>()
        .0
        .iter()
        .zip(target.as_chunks::<3>().0)
        .map(|(p, t)| p.iter().zip(t).map(|(p, t)| (p.clamp(0.0, 1.0) - t.clamp(0.0, 1.0)).abs()).sum::<f32>() / 3.0)
        .flat_map(|error| error_colour(error / ERROR_FULL_SCALE))
        .collect();
    Canvas::from_rgb8(&colours, height, width)
}

/// Returns the colour of a share of the full scale, from black over red and yellow to white.
fn error_colour(share: f32) -> [u8; 3] {
    [0.0, 1.0, 2.0].map(|start| ((3.0 * share - start).clamp(0.0, 1.0) * 255.0).round() as u8)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_error_map_saturates_at_its_full_scale() {
        let map = error_map(&[0.5, 0.5, 0.5, 0.75, 0.75, 0.75, 1.0, 1.0, 1.0], &[0.5; 9], 1, 3).unwrap();
        assert_eq!([0, 1, 2].map(|x| map.pixel(x, 0)), [[0; 3], [255; 3], [255; 3]]);
        assert_eq!([1.0 / 3.0, 0.5].map(error_colour), [[255, 0, 0], [255, 128, 0]]);
        assert!(error_map(&[0.5; 9], &[0.5; 12], 1, 3).is_err());
        assert!(error_map(&[0.5; 9], &[0.5; 9], 2, 3).is_err());
        assert!(error_map(&[f32::NAN; 9], &[0.5; 9], 1, 3).is_err());
    }

    #[test]
    fn fitted_images_keep_proportions_and_pixels() {
        for (size, expected) in [((64, 64), (64, 40)), ((200, 200), (200, 125)), ((16, 99), (16, 10))] {
            let fitted = Canvas::new(32, 20, [9, 9, 9]).fitted(size.0, size.1);
            assert_eq!((fitted.width(), fitted.height()), expected);
            assert_eq!(fitted.pixel(expected.0 / 2, expected.1 / 2), [9, 9, 9]);
        }
        assert_eq!(Canvas::from_unit(&[-1.0, 0.4999, 2.0], 1, 1).unwrap().pixel(0, 0), [0, 127, 255]);
        let image = Canvas::from_rgb8(&[0, 0, 0, 255, 255, 255], 1, 2).unwrap().fitted(6, 6);
        assert_eq!([0, 2, 3, 5].map(|x| image.pixel(x, 2)[0]), [0, 0, 255, 255]);
    }
}
