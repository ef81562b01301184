//! JPEG and PNG files: decoding with limits, encoding, checks for truncation.

use std::fs::File;
use std::io::{Cursor, Read, Seek, SeekFrom};
use std::path::Path;

use image::codecs::jpeg::JpegEncoder;
use image::codecs::png::PngEncoder;
use image::{ExtendedColorType, ImageDecoder, ImageEncoder, ImageFormat, ImageReader, Limits};

use crate::error::DataError;
use crate::files::bounded::read_bounded;
use crate::image::rgb_image::RgbImage;

/// Most columns or rows of a decoded image.
pub const MAX_SIDE: u32 = 16_384;
/// Most memory for decoding one image: 8,192 x 8,192 RGB and the decoder's own copy.
const MAX_DECODE_BYTES: u64 = 512 << 20;
/// Bytes at the end of a file in which its end marker is searched before the whole file is read.
const TAIL_BYTES: u64 = 512;
/// End marker of a JPEG.
const JPEG_END: &[u8] = &[0xff, 0xd9];
/// End of a PNG: the type of the last chunk, and its checksum.
const PNG_END: &[u8] = b"IEND\xae\x42\x60\x82";

/// Decodes a JPEG or PNG file to 8-bit RGB; gray becomes RGB, an alpha channel is dropped.
///
/// # Errors
/// [`DataError::BadImage`] with `key` and `frame`: another format, broken or truncated data, or a side above
/// [`MAX_SIDE`].
pub fn decode(bytes: &[u8], key: &str, frame: usize) -> Result<RgbImage, DataError> {
    let bad = |what: String| DataError::BadImage { key: key.to_owned(), frame, what };
    let Ok(format @ (ImageFormat::Jpeg | ImageFormat::Png)) = image::guess_format(bytes) else {
        return Err(bad(format!("its {} bytes are neither JPEG nor PNG", bytes.len())));
    };
    if format == ImageFormat::Jpeg && !has_jpeg_end(bytes) {
        return Err(bad(format!("its JPEG data of {} bytes is truncated", bytes.len())));
    }
    let mut limits = Limits::default();
    limits.max_image_width = Some(MAX_SIDE);
    limits.max_image_height = Some(MAX_SIDE);
    limits.max_alloc = Some(MAX_DECODE_BYTES);
    let mut reader = ImageReader::with_format(Cursor::new(bytes), format);
    reader.limits(limits);
    let picture = reader.decode().map_err(|error| bad(error.to_string()))?.into_rgb8();
    let (width, height) = picture.dimensions();
    if width == 0 || height == 0 {
        return Err(bad(format!("it is {width}x{height}")));
    }
    Ok(RgbImage { width: width as usize, height: height as usize, rgb: picture.into_raw() })
}

/// Reads the columns and rows of a JPEG or PNG file from its header.
///
/// # Errors
/// [`DataError::Io`], and [`DataError::BadScene`] for a file of another format.
pub(crate) fn read_size(path: &Path) -> Result<[usize; 2], DataError> {
    let bad = |what: String| DataError::BadScene { what, path: path.to_owned() };
    let metadata = std::fs::metadata(path).map_err(DataError::io("opening a picture", path))?;
    if !metadata.is_file() {
        return Err(bad("expected a picture, and it is no file".into()));
    }
    let reader = ImageReader::open(path).map_err(DataError::io("opening a picture", path))?;
    let reader = reader.with_guessed_format().map_err(DataError::io("reading a picture", path))?;
    if !matches!(reader.format(), Some(ImageFormat::Jpeg | ImageFormat::Png)) {
        return Err(bad("the picture is neither JPEG nor PNG".into()));
    }
    let (width, height) = reader
        .into_dimensions()
        .map_err(|error| bad(format!("the picture cannot be read: {}", error.to_string().trim_end())))?;
    if width == 0 || height == 0 {
        return Err(bad(format!("the picture is {width}x{height}")));
    }
    Ok([width as usize, height as usize])
}

/// Checks that a JPEG or PNG file of at most `limit` bytes is not truncated. Reads the last bytes of most files, and
/// all bytes of those with data after the image, as phones append it.
///
/// # Errors
/// [`DataError::Io`], and [`DataError::BadScene`] for a truncated file.
pub(crate) fn check_end(path: &Path, limit: u64) -> Result<(), DataError> {
    const READING: &str = "reading the end of a picture";
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
    let is_png = image::guess_format(&bytes).is_ok_and(|format| format == ImageFormat::Png);
    let is_whole = if is_png { bytes.windows(PNG_END.len()).any(|part| part == PNG_END) } else { has_jpeg_end(&bytes) };
    if is_whole {
        return Ok(());
    }
    let what = format!("the picture is truncated: its {num_bytes} bytes have no end marker");
    Err(DataError::BadScene { what, path: path.to_owned() })
}

/// The EXIF orientation of an image file, 2 to 8; `None` for 1 (upright), and for a file without one.
pub(crate) fn exif_orientation(path: &Path) -> Option<u8> {
    let mut decoder = ImageReader::open(path).ok()?.with_guessed_format().ok()?.into_decoder().ok()?;
    decoder.orientation().ok().map(image::metadata::Orientation::to_exif).filter(|orientation| *orientation != 1)
}

/// Whether the image ends before the file; the decoder would fill the missing part of a truncated JPEG with gray.
fn has_jpeg_end(bytes: &[u8]) -> bool {
    let padding = bytes.iter().rev().take_while(|byte| **byte == 0).count();
    bytes[..bytes.len() - padding].ends_with(JPEG_END) || ends_after_a_scan(bytes).unwrap_or_default()
}

/// Walks the segments of a JPEG up to the first end marker after a scan; appended data, such as a phone's film, may
/// contain any bytes. `None` if the data ends within a segment.
fn ends_after_a_scan(bytes: &[u8]) -> Option<bool> {
    let mut rest = bytes;
    let mut has_scan = false;
    loop {
        // In a scan 0xff is followed by 0 or a restart, before a marker it may be repeated.
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
/// [`DataError::Encode`] for an image whose `rgb` does not match its size, or beyond the format's limits.
pub fn encode_jpeg(frame: &RgbImage, quality: u8) -> Result<Vec<u8>, DataError> {
    let mut bytes = Vec::new();
    encode(JpegEncoder::new_with_quality(&mut bytes, quality), frame)?;
    Ok(bytes)
}

/// Encodes an image as PNG, without loss.
///
/// # Errors
/// As [`encode_jpeg`].
pub fn encode_png(frame: &RgbImage) -> Result<Vec<u8>, DataError> {
    let mut bytes = Vec::new();
    encode(PngEncoder::new(&mut bytes), frame)?;
    Ok(bytes)
}

fn encode(encoder: impl ImageEncoder, frame: &RgbImage) -> Result<(), DataError> {
    let &RgbImage { width, height, ref rgb } = frame;
    let bad = |what: String| DataError::Encode { width, height, what };
    if rgb.len() != width * height * 3 {
        return Err(bad(format!("it has {} values, expected {}", rgb.len(), width * height * 3)));
    }
    encoder
        .write_image(rgb, width as u32, height as u32, ExtendedColorType::Rgb8)
        .map_err(|error| bad(error.to_string()))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ramp(width: usize, height: usize) -> RgbImage {
        let rgb = (0..height).flat_map(|y| (0..width).flat_map(move |x| [(x * 3) as u8, (y * 5) as u8, 77])).collect();
        RgbImage { width, height, rgb }
    }

    #[test]
    fn png_round_trips_exactly_and_jpeg_within_a_few_levels() {
        let frame = ramp(40, 24);
        assert_eq!(decode(&encode_png(&frame).unwrap(), "k", 0).unwrap(), frame);
        let jpeg = decode(&encode_jpeg(&frame, 95).unwrap(), "k", 0).unwrap();
        let worst = jpeg.rgb.iter().zip(&frame.rgb).map(|(a, b)| a.abs_diff(*b)).max();
        assert!(worst.is_some_and(|worst| worst < 16), "{worst:?}"); // colour is stored at half resolution
    }

    #[test]
    fn an_unreadable_jpeg_names_scene_and_frame() {
        let jpeg = encode_jpeg(&ramp(40, 24), 90).unwrap();
        for length in [40, jpeg.len() / 2, jpeg.len() - 2] {
            let message = decode(&jpeg[..length], "00ff", 7).unwrap_err().to_string();
            assert!(message.starts_with("frame 7 of scene 00ff cannot be decoded: "), "{message}");
            assert!(message.contains("truncated"), "{message}");
        }
        let broken = b"\xff\xd8\xff\xe0\x00\x04\xff\xda\x00\x02\xff\xd9"; // a scan without tables or sizes
        let message = decode(broken, "00ff", 7).unwrap_err().to_string();
        assert!(message.starts_with("frame 7 of scene 00ff cannot be decoded: "), "{message}");
        assert_eq!(decode(&[&jpeg[..], &[0; 9]].concat(), "00ff", 7).unwrap().width, 40); // padding is common
        let message = decode(b"GIF89a....", "00ff", 7).unwrap_err().to_string();
        assert!(message.ends_with("its 10 bytes are neither JPEG nor PNG"), "{message}");
    }

    #[test]
    fn whatever_is_appended_to_a_jpeg_does_not_make_it_truncated() {
        let jpeg = encode_jpeg(&ramp(40, 24), 90).unwrap();
        let mut state = 1_u32;
        let mut film: Vec<u8> = std::iter::repeat_with(|| {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 24) as u8
        })
        .take(400_000)
        .collect();
        film.extend(b"\xff\xdaend");
        let with_film = [&jpeg[..], &film].concat();
        assert_eq!(decode(&with_film, "k", 0).unwrap(), decode(&jpeg, "k", 0).unwrap());
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.jpg");
        std::fs::write(&path, &with_film).unwrap();
        check_end(&path, 1 << 20).unwrap();
    }

    #[test]
    fn a_jpeg_ends_behind_its_scans_and_not_within_a_segment() {
        let head = b"\xff\xd8\xff\xe1\x00\x06\xff\xd8\xff\xd9\xff\xff\xda\x00\x04\xff\xd9\x01\xff\x00\x02\xff\xd3\x03";
        let scans = [&head[..], b"\xff\xc4\x00\x04\xff\xd9\xff\xda\x00\x02\x05\xff\x00"].concat();
        for whole in [&head[..], &scans] {
            assert!(has_jpeg_end(&[whole, b"\xff\xd9"].concat()));
            assert!(has_jpeg_end(&[whole, b"\xff\xff\xd9 film \xff\xda"].concat()));
            assert!(!has_jpeg_end(&[whole, b"\xff"].concat()));
        }
        // The end markers of a preview and of a table are not the picture's.
        for length in 10..scans.len() {
            let part = &scans[..length];
            assert!(part.ends_with(JPEG_END) || !has_jpeg_end(part), "{length}");
        }
    }

    #[test]
    fn a_png_that_claims_to_be_huge_is_refused_before_memory_is_taken() {
        let mut png = encode_png(&ramp(4, 4)).unwrap();
        png[16..24].copy_from_slice(&[0, 1, 0, 0, 0, 1, 0, 0]); // 65,536 x 65,536
        let checksum = crc32fast::hash(&png[12..29]).to_be_bytes();
        png[29..33].copy_from_slice(&checksum);
        let message = decode(&png, "k", 0).unwrap_err().to_string();
        assert!(message.contains("limit") || message.contains("exceeds"), "{message}");
    }
}
