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
    ///
    /// # Errors
    /// [`EvalError::BadImage`] unless there are `height * width * 3` values.
    pub fn from_rgb8(rgb: &[u8], height: usize, width: usize) -> Result<Self, EvalError> {
        let expected = height * width * 3;
        let image = RgbImage::from_raw(width as u32, height as u32, rgb.to_vec()).filter(|_| rgb.len() == expected);
        image.map(|rgb| Self { rgb }).ok_or_else(|| EvalError::size_mismatch(expected, rgb.len()))
    }

    /// Rounds a `[height, width, 3]` array in [0, 1] to 8 bits; values outside are clamped.
    ///
    /// # Errors
    /// [`EvalError::BadImage`] unless there are `height * width * 3` values.
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

    /// Repeats every pixel `factor` times along both axes.
    #[must_use]
    pub fn magnified(&self, factor: usize) -> Self {
        let factor = factor.max(1) as u32;
        let (width, height) = (self.rgb.width() * factor, self.rgb.height() * factor);
        Self { rgb: RgbImage::from_fn(width, height, |x, y| *self.rgb.get_pixel(x / factor, y / factor)) }
    }

    /// Scales the image to fit into `width` by `height` pixels without distortion. Whole factors repeat pixels; for other
    /// factors the next larger magnification is shrunk, which keeps the edges of small images sharp.
    #[must_use]
    pub fn fitted(&self, width: usize, height: usize) -> Self {
        let scale = (width as f64 / self.width() as f64).min(height as f64 / self.height() as f64);
        let magnified = self.magnified(scale.ceil() as usize);
        let scaled = |size: usize| ((size as f64 * scale).round() as u32).max(1);
        let (width, height) = (scaled(self.width()), scaled(self.height()));
        if (width, height) == magnified.rgb.dimensions() {
            return magnified;
        }
        Self { rgb: image::imageops::resize(&magnified.rgb, width, height, image::imageops::FilterType::Triangle) }
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

    /// Encodes the image as PNG.
    ///
    /// # Errors
    /// For an image without pixels.
    pub fn png(&self) -> std::io::Result<Vec<u8>> {
        let mut png = std::io::Cursor::new(Vec::new());
        self.rgb.write_to(&mut png, image::ImageFormat::Png).map_err(std::io::Error::other)?;
        Ok(png.into_inner())
    }

    /// Writes the image as a PNG file, atomically.
    pub fn write_png(&self, path: &Path) -> Result<(), EvalError> {
        self.png().and_then(|png| replace_file(path, &png)).map_err(EvalError::io("writing the image", path))
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

/// Makes an image of the mean absolute error over red, green and blue, in the colours of [`error_colour`]. Refuses a
/// NaN or an infinity, which would look like no error.
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

/// Returns the colour of a share of the full scale, from black over purple and orange to pale yellow: Matplotlib's
/// `inferno` with its evenly growing lightness, as a polynomial of degree 6.
pub fn error_colour(share: f32) -> [u8; 3] {
    const COEFFICIENTS: [[f64; 3]; 7] = [
        [0.000_219, 0.001_651, -0.019_481],
        [0.106_513, 0.563_956, 3.932_712],
        [11.602_493, -3.972_854, -15.942_394],
        [-41.703_996, 17.436_399, 44.354_145],
        [77.162_936, -33.402_36, -81.807_31],
        [-71.319_43, 32.626_064, 73.209_52],
        [25.131_126, -12.242_669, -23.070_325],
    ];
    let share = f64::from(share.clamp(0.0, 1.0));
    [0, 1, 2].map(|channel| {
        let value = COEFFICIENTS.iter().rev().fold(0.0, |sum, coefficients| sum * share + coefficients[channel]);
        (value.clamp(0.0, 1.0) * 255.0).round() as u8
    })
}

#[cfg(test)]
mod tests {
    use embedded_graphics::mono_font::iso_8859_1::FONT_7X13;

    use super::*;

    fn lightness([r, g, b]: [u8; 3]) -> f32 {
        0.2126 * f32::from(r) + 0.7152 * f32::from(g) + 0.0722 * f32::from(b)
    }

    #[test]
    fn colours_start_black_and_grow_lighter() {
        assert_eq!(error_colour(0.0), [0, 0, 0]);
        let shades: Vec<f32> = (0..=64).map(|i| lightness(error_colour(i as f32 / 64.0))).collect();
        assert!(shades.is_sorted(), "{shades:?}");
        assert!(shades[64] > 240.0);
    }

    #[test]
    fn the_error_map_saturates_at_its_full_scale() {
        let map = error_map(&[0.5, 0.5, 0.5, 0.75, 0.75, 0.75, 1.0, 1.0, 1.0], &[0.5; 9], 1, 3).unwrap();
        assert_eq!([0, 1, 2].map(|x| map.pixel(x, 0)), [[0, 0, 0], error_colour(1.0), error_colour(1.0)]);
        assert!(error_map(&[0.5; 9], &[0.5; 12], 1, 3).is_err());
        assert!(error_map(&[0.5; 9], &[0.5; 9], 2, 3).is_err());
        assert!(error_map(&[f32::NAN; 9], &[0.5; 9], 1, 3).is_err());
    }

    #[test]
    fn unit_values_round_and_clamp() {
        let image = Canvas::from_unit(&[-1.0, 0.4999, 2.0], 1, 1).unwrap();
        assert_eq!(image.pixel(0, 0), [0, 127, 255]);
    }

    #[test]
    fn fitted_images_keep_proportions_and_pixels() {
        for (size, expected) in [((64, 64), (64, 40)), ((200, 200), (200, 125)), ((16, 99), (16, 10))] {
            let fitted = Canvas::new(32, 20, [9, 9, 9]).fitted(size.0, size.1);
            assert_eq!((fitted.width(), fitted.height()), expected);
            assert_eq!(fitted.pixel(expected.0 / 2, expected.1 / 2), [9, 9, 9]);
        }
        let image = Canvas::from_rgb8(&[0, 0, 0, 255, 255, 255], 1, 2).unwrap().fitted(6, 6);
        assert_eq!([0, 2, 3, 5].map(|x| image.pixel(x, 2)[0]), [0, 0, 255, 255]);
    }

    #[test]
    fn png_files_read_back() {
        let folder = tempfile::tempdir().unwrap();
        let mut image = Canvas::new(40, 20, [1, 2, 3]);
        image.write_text("Hi", 2, 2, &FONT_7X13, [255, 255, 255]);
        image.write_png(&folder.path().join("a.png")).unwrap();
        let read = image::open(folder.path().join("a.png")).unwrap().to_rgb8();
        assert_eq!(read, image.rgb);
        assert!(read.pixels().any(|pixel| pixel.0 == [255, 255, 255]));
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "no temporary file");
        let error = Canvas::new(1, 1, [0; 3]).write_png(Path::new("no/such/folder/a.png")).unwrap_err().to_string();
        assert!(error.starts_with("writing the image failed: "), "{error}");
        assert!(error.ends_with(": no/such/folder/a.png"), "{error}");
    }
}
