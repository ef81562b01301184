//! JPEG and PNG files: bounded decoding, encoding, detection of truncated files.

use std::fs::File;
use std::io::{Cursor, Read, Seek, SeekFrom};
use std::path::Path;

use clift_core::RgbImage;
use image::codecs::jpeg::JpegEncoder;
use image::codecs::png::PngEncoder;
use image::metadata::Orientation;
use image::{DynamicImage, ExtendedColorType, ImageDecoder, ImageEncoder, ImageFormat, ImageReader, Limits};

use crate::error::DataError;
use crate::files::bounded::read_bounded;

/// Largest number of columns or rows of a decoded image.
pub const MAX_SIDE: u32 = 16_384;
/// Largest memory for decoding one image: 8,192 x 8,192 RGB and the decoder's copy.
const MAX_DECODE_BYTES: u64 = 512 << 20;
/// Bytes at the end of a file that are searched for the end marker before the whole file is read.
const TAIL_BYTES: u64 = 512;
const JPEG_END: &[u8] = &[0xff, 0xd9];
/// End of a PNG: type and checksum of the last chunk.
const PNG_END: &[u8] = b"IEND\xae\x42\x60\x82";

/// Decodes a JPEG or PNG file to 8-bit RGB. Gray becomes RGB, an alpha channel is dropped.
///
/// # Errors
/// [`DataError::BadImage`] with `key` and `frame` for another format, broken or truncated data, and a side above
/// 16,384 pixels.
pub fn decode_image(bytes: &[u8], key: &str, frame: usize) -> Result<RgbImage, DataError> {
    decode_with_alpha(bytes, key, frame).map(|(image, _)| image)
}

/// Decodes a JPEG or PNG file as [`decode_image`], and its alpha channel, `[height, width]`, if it has one.
pub(crate) fn decode_with_alpha(
    bytes: &[u8],
    key: &str,
    frame: usize,
) -> Result<(RgbImage, Option<Vec<u8>>), DataError> {
    let bad = |what: String| DataError::BadImage { key: key.to_owned(), frame, what };
    let image = decode(bytes).map_err(bad)?;
    let alpha = image.color().has_alpha().then(|| image.to_rgba8().pixels().map(|pixel| pixel.0[3]).collect());
    Ok((rgb_image(image.into_rgb8()), alpha))
}

/// Decodes a JPEG or PNG file.
///
/// # Errors
/// The problem, as a sentence.
pub(crate) fn decode(bytes: &[u8]) -> Result<DynamicImage, String> {
    let mut reader = ImageReader::with_format(Cursor::new(bytes), known_format(bytes)?);
    reader.limits(limits());
    let image = reader.decode().map_err(|error| error.to_string())?;
    match (image.width(), image.height()) {
        (0, _) | (_, 0) => Err(format!("the image is {}x{}", image.width(), image.height())),
        _ => Ok(image),
    }
}

fn rgb_image(image: image::RgbImage) -> RgbImage {
    let (width, height) = image.dimensions();
    RgbImage { width: width as usize, height: height as usize, rgb: image.into_raw() }
}

fn limits() -> Limits {
    let mut limits = Limits::default();
    limits.max_image_width = Some(MAX_SIDE);
    limits.max_image_height = Some(MAX_SIDE);
    limits.max_alloc = Some(MAX_DECODE_BYTES);
    limits
}

/// Returns the format of a JPEG or PNG file with an end marker.
pub(crate) fn known_format(bytes: &[u8]) -> Result<ImageFormat, String> {
    let Ok(format @ (ImageFormat::Jpeg | ImageFormat::Png)) = image::guess_format(bytes) else {
        return Err(format!("the {} bytes are neither JPEG nor PNG", bytes.len()));
    };
    if has_end(bytes, format) {
        return Ok(format);
    }
    let name = if format == ImageFormat::Png { "PNG" } else { "JPEG" };
    Err(format!("the {name} data of {} bytes is truncated", bytes.len()))
}

fn has_end(bytes: &[u8], format: ImageFormat) -> bool {
    if format == ImageFormat::Png {
        bytes.windows(PNG_END.len()).rev().any(|part| part == PNG_END)
    } else {
        has_jpeg_end(bytes)
    }
}

/// Reads the columns and rows of a JPEG or PNG file, as stored, and its EXIF orientation.
pub(crate) fn read_header(path: &Path) -> Result<([usize; 2], Orientation), DataError> {
    let bad = |what: String| DataError::BadScene { what, path: path.to_owned() };
    let metadata = std::fs::metadata(path).map_err(DataError::io("opening an image", path))?;
    if !metadata.is_file() {
        return Err(bad("expected an image file, found a folder or device".into()));
    }
    let reader = ImageReader::open(path).map_err(DataError::io("opening an image", path))?;
    let mut reader = reader.with_guessed_format().map_err(DataError::io("reading an image", path))?;
    if !matches!(reader.format(), Some(ImageFormat::Jpeg | ImageFormat::Png)) {
        return Err(bad("the image is neither JPEG nor PNG".into()));
    }
    reader.limits(limits());
    let mut decoder = reader
        .into_decoder()
        .map_err(|error| bad(format!("the image cannot be read: {}", error.to_string().trim_end())))?;
    let (width, height) = decoder.dimensions();
    if width == 0 || height == 0 {
        return Err(bad(format!("the image is {width}x{height}")));
    }
    // Broken EXIF data does not affect the pixels.
    let orientation = decoder.orientation().unwrap_or(Orientation::NoTransforms);
    Ok(([width as usize, height as usize], orientation))
}

/// Returns whether a file is a PNG with an alpha channel; `false` for a file that cannot be read.
pub(crate) fn has_alpha(path: &Path) -> bool {
    let is_png = path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("png"));
    let decoder = || ImageReader::open(path).ok()?.with_guessed_format().ok()?.into_decoder().ok();
    is_png && decoder().is_some_and(|decoder| decoder.color_type().has_alpha())
}

/// Returns the columns and rows of a JPEG or PNG file, as stored.
pub fn image_size(path: &Path) -> Result<[usize; 2], DataError> {
    read_header(path).map(|(size, _)| size)
}

/// Returns the EXIF orientation of a JPEG or PNG file in memory.
pub(crate) fn exif_orientation(bytes: &[u8]) -> Orientation {
    let decoder =
        ImageReader::new(Cursor::new(bytes)).with_guessed_format().ok().and_then(|reader| reader.into_decoder().ok());
    decoder.and_then(|mut decoder| decoder.orientation().ok()).unwrap_or(Orientation::NoTransforms)
}

pub(crate) fn apply_orientation(image: RgbImage, orientation: Orientation) -> RgbImage {
    if orientation == Orientation::NoTransforms {
        return image;
    }
    let RgbImage { width, height, rgb } = image;
    // A decoded image has three values per pixel, so that none is lost here.
    let pixels = image::RgbImage::from_raw(width as u32, height as u32, rgb).unwrap_or_default();
    let mut turned = DynamicImage::ImageRgb8(pixels);
    turned.apply_orientation(orientation);
    rgb_image(turned.into_rgb8())
}

/// Checks that a JPEG or PNG file of at most `limit` bytes is not truncated. Reads the last bytes only, or the whole
/// file where data follows the image, such as a phone's film.
pub(crate) fn check_end(path: &Path, limit: u64) -> Result<(), DataError> {
    const READING: &str = "reading the end of an image";
    let io = || DataError::io(READING, path);
    let mut file = File::open(path).map_err(io())?;
    let num_bytes = file.metadata().map_err(io())?.len();
    let mut tail = Vec::new();
    file.seek(SeekFrom::Start(num_bytes.saturating_sub(TAIL_BYTES))).map_err(io())?;
    file.take(TAIL_BYTES).read_to_end(&mut tail).map_err(io())?;
    let padding = tail.iter().rev().take_while(|byte| **byte == 0).count();
    tail.truncate(tail.len() - padding);
    if tail.ends_with(JPEG_END) || tail.ends_with(PNG_END) {
        return Ok(());
    }
    let bytes = read_bounded(path, limit, READING)?;
    if has_end(&bytes, image::guess_format(&bytes).unwrap_or(ImageFormat::Jpeg)) {
        return Ok(());
    }
    let what = format!("the image is truncated: its {num_bytes} bytes have no end marker");
    Err(DataError::BadPhoto { reason: "whose image is truncated", what, path: path.to_owned() })
}

/// Returns whether the JPEG data has its end marker. The decoder fills the missing part of a truncated JPEG with gray.
fn has_jpeg_end(bytes: &[u8]) -> bool {
    let padding = bytes.iter().rev().take_while(|byte| **byte == 0).count();
    bytes[..bytes.len() - padding].ends_with(JPEG_END) || has_end_after_scan(bytes).unwrap_or_default()
}

/// Reads the segments of a JPEG up to the first end marker and returns whether a scan precedes it. Data after the
/// marker may contain any bytes. Returns `None` if the data ends within a segment.
fn has_end_after_scan(bytes: &[u8]) -> Option<bool> {
    let mut rest = bytes;
    let mut has_scan = false;
    loop {
        // In a scan, 0xff precedes 0 or a restart marker; before a marker, 0xff may be repeated.
        let is_marker = |pair: &[u8]| pair[0] == 0xff && !matches!(pair[1], 0x00 | 0xd0..=0xd7 | 0xff);
        let at = rest.windows(2).position(is_marker)?;
        let marker = rest[at + 1];
        rest = &rest[at + 2..];
        match marker {
            0xd9 => return Some(has_scan),
            0x01 | 0xd8 => {} // without a length
            _ => {
                has_scan |= marker == 0xda;
                let length = rest.first_chunk().map(|length| u16::from_be_bytes(*length))?;
                rest = rest.get(usize::from(length)..)?;
            }
        }
    }
}

/// Encodes an image as JPEG of `quality` in `1..=100`.
///
/// # Errors
/// [`DataError::Encode`] for an image whose `rgb` does not match its size, and beyond the limits of the format.
pub fn encode_jpeg(image: &RgbImage, quality: u8) -> Result<Vec<u8>, DataError> {
    let mut bytes = Vec::new();
    encode(JpegEncoder::new_with_quality(&mut bytes, quality), image).map(|()| bytes)
}

/// Encodes an image as PNG (lossless).
pub fn encode_png(image: &RgbImage) -> Result<Vec<u8>, DataError> {
    let mut bytes = Vec::new();
    encode(PngEncoder::new(&mut bytes), image).map(|()| bytes)
}

fn encode(encoder: impl ImageEncoder, image: &RgbImage) -> Result<(), DataError> {
    let &RgbImage { width, height, ref rgb } = image;
    let bad = |what: String| DataError::Encode { width, height, what };
    if rgb.len() != width * height * 3 {
        return Err(bad(format!("the image has {} values, expected {}", rgb.len(), width * height * 3)));
    }
    encoder
        .write_image(rgb, width as u32, height as u32, ExtendedColorType::Rgb8)
        .map_err(|error| bad(error.to_string()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::ramp;

    #[test]
    fn png_round_trips_exactly_and_jpeg_closely() {
        let image = ramp(40, 24);
        assert_eq!(decode_image(&encode_png(&image).unwrap(), "k", 0).unwrap(), image);
        let jpeg = decode_image(&encode_jpeg(&image, 95).unwrap(), "k", 0).unwrap();
        let worst = jpeg.rgb.iter().zip(&image.rgb).map(|(a, b)| a.abs_diff(*b)).max();
        assert!(worst.is_some_and(|worst| worst < 16), "{worst:?}"); // JPEG stores colour at half the resolution
    }

    #[test]
    fn unreadable_files_name_scene_and_frame() {
        let jpeg = encode_jpeg(&ramp(40, 24), 90).unwrap();
        for length in [40, jpeg.len() / 2, jpeg.len() - 2] {
            let message = decode_image(&jpeg[..length], "00ff", 7).unwrap_err().to_string();
            assert!(message.starts_with("frame 7 of scene 00ff cannot be decoded: "), "{message}");
            assert!(message.contains("truncated"), "{message}");
        }
        let broken = b"\xff\xd8\xff\xe0\x00\x04\xff\xda\x00\x02\xff\xd9"; // a scan without tables and sizes
        let message = decode_image(broken, "00ff", 7).unwrap_err().to_string();
        assert!(message.starts_with("frame 7 of scene 00ff cannot be decoded: "), "{message}");
        assert_eq!(decode_image(&[&jpeg[..], &[0; 9]].concat(), "00ff", 7).unwrap().width, 40); // padding is common
        let message = decode_image(b"GIF89a....", "00ff", 7).unwrap_err().to_string();
        assert!(message.ends_with("the 10 bytes are neither JPEG nor PNG"), "{message}");
    }

    #[test]
    fn jpeg_ends_after_its_scans() {
        let head = b"\xff\xd8\xff\xe1\x00\x06\xff\xd8\xff\xd9\xff\xff\xda\x00\x04\xff\xd9\x01\xff\x00\x02\xff\xd3\x03";
        let scans = [&head[..], b"\xff\xc4\x00\x04\xff\xd9\xff\xda\x00\x02\x05\xff\x00"].concat();
        for whole in [&head[..], &scans] {
            assert!(has_jpeg_end(&[whole, b"\xff\xd9"].concat()));
            assert!(has_jpeg_end(&[whole, b"\xff\xff\xd9 film \xff\xda"].concat()));
            assert!(!has_jpeg_end(&[whole, b"\xff"].concat()));
        }
        // The end markers of a preview and of a table are not the image's.
        for length in 10..scans.len() {
            let part = &scans[..length];
            assert!(part.ends_with(JPEG_END) || !has_jpeg_end(part), "{length}");
        }
    }

    #[test]
    fn png_with_a_huge_header_is_refused() {
        let mut png = encode_png(&ramp(4, 4)).unwrap();
        png[16..24].copy_from_slice(&[0, 1, 0, 0, 0, 1, 0, 0]); // 65,536 x 65,536
        let checksum = crc32fast::hash(&png[12..29]).to_be_bytes();
        png[29..33].copy_from_slice(&checksum);
        let message = decode_image(&png, "k", 0).unwrap_err().to_string();
        assert!(message.contains("limit") || message.contains("exceeds"), "{message}");
    }
}
