//! Pictures: decoding and encoding files, and fitting a frame with its intrinsics to the model's size.

use std::fs::File;
use std::io::{Cursor, Read, Seek, SeekFrom};
use std::path::Path;

use image::codecs::jpeg::JpegEncoder;
use image::codecs::png::PngEncoder;
use image::{ExtendedColorType, ImageDecoder, ImageEncoder, ImageFormat, ImageReader, Limits};
use serde::{Deserialize, Serialize};

use crate::bounded::read_bounded;
use crate::camera::{Intrinsics, IntrinsicsNorm};
use crate::clip::Frame;
use crate::error::DataError;
use crate::lanczos::{Window, resize_lanczos_window};

/// Most columns or rows of a picture that is decoded.
pub const MAX_SIDE: u32 = 16_384;
/// Most memory that decoding one picture may take: 8,192 x 8,192 RGB and the decoder's own copy.
const MAX_DECODE_BYTES: u64 = 512 << 20;
/// Bytes at the end of a file that its end marker is looked for in before all of it is read.
const TAIL_BYTES: u64 = 512;
/// What a JPEG ends in.
const JPEG_END: &[u8] = &[0xff, 0xd9];
/// What a PNG ends in: the type of its last chunk, and the checksum.
const PNG_END: &[u8] = b"IEND\xae\x42\x60\x82";

/// Where the principal point goes when a picture is cropped.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Crop {
    /// It keeps its place relative to the width and height, as published numbers have it: half a pixel off where the
    /// rescaled picture has an odd margin, and more where it is not in the middle.
    #[default]
    Protocol,
    /// It moves with the pixels.
    Exact,
}

impl Crop {
    /// By default the key is not written: what runs from before it existed have on disk stays as it is.
    #[allow(clippy::trivially_copy_pass_by_ref)] // serde's signature
    pub fn is_default(&self) -> bool {
        *self == Self::default()
    }
}

/// Decodes a JPEG or PNG file to 8-bit RGB; grey becomes RGB, an alpha channel is dropped.
///
/// # Errors
/// [`DataError::BadImage`], which names `key` and `frame`: another format, broken or truncated data, or more than
/// [`MAX_SIDE`] on a side.
pub fn decode(bytes: &[u8], key: &str, frame: usize) -> Result<Frame, DataError> {
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
    Ok(Frame { width: width as usize, height: height as usize, rgb: picture.into_raw() })
}

/// Reads the columns and rows of a JPEG or PNG file from its head.
///
/// # Errors
/// [`DataError::Io`], and [`DataError::BadScene`] for what is no picture.
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

/// Checks that the end of a JPEG or PNG file of at most `limit` bytes is there. Of most files the last bytes are read; of
/// those with something behind the picture, as phones append it, everything.
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

/// The EXIF orientation of a picture file, 2 to 8, if it says that the picture is to be turned or mirrored.
pub(crate) fn exif_orientation(path: &Path) -> Option<u8> {
    let mut decoder = ImageReader::open(path).ok()?.with_guessed_format().ok()?.into_decoder().ok()?;
    decoder.orientation().ok().map(image::metadata::Orientation::to_exif).filter(|orientation| *orientation != 1)
}

/// Whether the picture ends before the file does; the decoder fills what is missing of a truncated JPEG with grey.
fn has_jpeg_end(bytes: &[u8]) -> bool {
    let padding = bytes.iter().rev().take_while(|byte| **byte == 0).count();
    bytes[..bytes.len() - padding].ends_with(JPEG_END) || ends_after_a_scan(bytes).unwrap_or_default()
}

/// Walks the segments of a JPEG up to the first end marker behind a scan: what is appended to it, such as a phone's film,
/// may look like anything. `None` where the data stops within a segment.
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

/// Encodes a frame as JPEG of `quality` in `1..=100`.
pub fn encode_jpeg(frame: &Frame, quality: u8) -> Result<Vec<u8>, DataError> {
    let mut bytes = Vec::new();
    encode(JpegEncoder::new_with_quality(&mut bytes, quality), frame)?;
    Ok(bytes)
}

/// Encodes a frame as PNG, without loss.
pub fn encode_png(frame: &Frame) -> Result<Vec<u8>, DataError> {
    let mut bytes = Vec::new();
    encode(PngEncoder::new(&mut bytes), frame)?;
    Ok(bytes)
}

fn encode(encoder: impl ImageEncoder, frame: &Frame) -> Result<(), DataError> {
    let &Frame { width, height, ref rgb } = frame;
    let bad = |what: String| DataError::Encode { width, height, what };
    if rgb.len() != width * height * 3 {
        return Err(bad(format!("it has {} values, expected {}", rgb.len(), width * height * 3)));
    }
    encoder
        .write_image(rgb, width as u32, height as u32, ExtendedColorType::Rgb8)
        .map_err(|error| bad(error.to_string()))
}

/// Rescales a frame until it just covers `width` by `height`, crops the centre, and moves its intrinsics along
/// (pixelSplat's protocol). Focal lengths and the way from the centre to the principal point follow the rescaled picture.
/// The centre stays the centre, which is what the published numbers use and is half a pixel off where the rescaled
/// picture has an odd margin; `exact_principal_point` moves it with the crop instead.
///
// Departs from the protocol, which keeps the normalised position: the same for a principal point in the centre, as
// RealEstate10K has it, and half a pixel wrong for a phone picture cropped to a square.
///
/// # Errors
/// [`DataError::Upscale`] when the target is larger than the frame.
pub fn fit(
    frame: &Frame,
    intrinsics_norm: IntrinsicsNorm,
    width: usize,
    height: usize,
    exact_principal_point: bool,
) -> Result<(Frame, Intrinsics), DataError> {
    if width > frame.width || height > frame.height {
        return Err(DataError::Upscale { width, height, from_width: frame.width, from_height: frame.height });
    }
    let (scaled_width, scaled_height) = covering_size((frame.width, frame.height), (width, height));
    let (column, row) = ((scaled_width - width) / 2, (scaled_height - height) / 2);
    let window = Window { column, row, width, height };
    let cropped = resize_lanczos_window(frame, scaled_width, scaled_height, window);
    let in_scaled = intrinsics_norm.to_pixels(scaled_width, scaled_height);
    let (cx, cy) = if exact_principal_point {
        (in_scaled.cx - column as f64, in_scaled.cy - row as f64)
    } else {
        let from_centre = |at: f64, scaled: usize| (at - 0.5) * scaled as f64;
        let x = width as f64 / 2.0 + from_centre(intrinsics_norm.cx, scaled_width);
        (x, height as f64 / 2.0 + from_centre(intrinsics_norm.cy, scaled_height))
    };
    Ok((cropped, Intrinsics { fx: in_scaled.fx, fy: in_scaled.fy, cx, cy }))
}

/// The smallest size with the aspect ratio of `from` that covers `to`; both as (width, height).
fn covering_size(from: (usize, usize), to: (usize, usize)) -> (usize, usize) {
    let scale = (to.1 as f64 / from.1 as f64).max(to.0 as f64 / from.0 as f64);
    let side = |from: usize| (from as f64 * scale).round_ties_even() as usize;
    (side(from.0), side(from.1))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ramp(width: usize, height: usize) -> Frame {
        let rgb = (0..height).flat_map(|y| (0..width).flat_map(move |x| [(x * 3) as u8, (y * 5) as u8, 77])).collect();
        Frame { width, height, rgb }
    }

    #[test]
    fn fitted_sizes_crops_and_focal_factors_equal_the_protocols_table() {
        // (source) -> (target): rescaled size, crop offset, factor of fx, exact principal point, all as width first.
        let table = [
            ((640, 360), (256, 256), (455, 256), (99, 0), 1.777_34, 128.5),
            ((480, 270), (448, 256), (455, 256), (3, 0), 1.015_625, 224.5),
            ((960, 540), (448, 256), (455, 256), (3, 0), 1.015_625, 224.5),
            ((640, 360), (448, 256), (455, 256), (3, 0), 1.015_625, 224.5),
        ];
        for (from, to, scaled, offset, factor, exact) in table {
            assert_eq!(covering_size(from, to), scaled);
            assert_eq!(((scaled.0 - to.0) / 2, (scaled.1 - to.1) / 2), offset);
            let norm = IntrinsicsNorm { fx: 0.9, fy: 1.6, cx: 0.5, cy: 0.5 };
            let frame = Frame { width: from.0, height: from.1, rgb: vec![9; from.0 * from.1 * 3] };
            let (fitted, protocol) = fit(&frame, norm, to.0, to.1, false).unwrap();
            assert_eq!((fitted.width, fitted.height, fitted.rgb.len()), (to.0, to.1, to.0 * to.1 * 3));
            assert!((protocol.fx / to.0 as f64 / norm.fx - factor).abs() < 1e-5, "{protocol:?}"); // printed to 5 digits
            assert_eq!((protocol.fy, protocol.cx, protocol.cy), (1.6 * 256.0, to.0 as f64 / 2.0, 128.0));
            let (_, moved) = fit(&frame, norm, to.0, to.1, true).unwrap();
            assert_eq!((moved.fx, moved.cx, moved.cy), (protocol.fx, exact, 128.0));
        }
    }

    #[test]
    fn a_crop_without_rescaling_takes_the_centre_pixels() {
        let frame = ramp(9, 4);
        let norm = IntrinsicsNorm { fx: 1.0, fy: 1.0, cx: 0.6, cy: 0.5 };
        let (fitted, intrinsics) = fit(&frame, norm, 4, 4, true).unwrap();
        for y in 0..4 {
            for x in 0..4 {
                let (got, expected) = ((y * 4 + x) * 3, (y * 9 + x + 2) * 3);
                assert_eq!(fitted.rgb[got..got + 3], frame.rgb[expected..expected + 3]);
            }
        }
        assert!((intrinsics.cx - 3.4).abs() < 1e-12, "{intrinsics:?}"); // 0.6 * 9 - 2
    }

    #[test]
    fn a_principal_point_off_the_centre_is_half_a_pixel_from_the_exact_one_at_most() {
        let frame = ramp(108, 192);
        let norm = IntrinsicsNorm { fx: 1.27, fy: 0.72, cx: 0.6, cy: 0.55 };
        let [protocol, exact] = [false, true].map(|exact| fit(&frame, norm, 64, 64, exact).unwrap().1);
        // 64 x 114, 25 rows cut off above and below: 0.55 * 114 - 25 = 37.7.
        assert!((exact.cx - 38.4).abs() < 1e-12 && (exact.cy - 37.7).abs() < 1e-12, "{exact:?}");
        assert!((protocol.cx - exact.cx).abs() < 1e-12 && (protocol.cy - exact.cy).abs() < 1e-12, "{protocol:?}");
        let odd = fit(&ramp(108, 193), norm, 64, 63, false).unwrap().1;
        let exact = fit(&ramp(108, 193), norm, 64, 63, true).unwrap().1;
        assert!((odd.cy - exact.cy).abs() <= 0.5 + 1e-12, "{odd:?} {exact:?}");
    }

    #[test]
    fn upscaling_is_refused_with_both_sizes() {
        let norm = IntrinsicsNorm { fx: 1.0, fy: 1.0, cx: 0.5, cy: 0.5 };
        let message = fit(&ramp(64, 36), norm, 32, 48, false).unwrap_err().to_string();
        assert!(message.contains("32x48") && message.contains("64x36"), "{message}");
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

    #[test]
    fn a_jpeg_is_decoded_rescaled_and_cropped_as_pillow_does_it_to_a_fraction_of_a_level() {
        let bytes = include_bytes!("../../../data-fixtures/reference/fitted.safetensors");
        let tensors = safetensors::SafeTensors::deserialize(bytes).unwrap();
        let norm = IntrinsicsNorm { fx: 1.0, fy: 1.0, cx: 0.5, cy: 0.5 };
        for number in 0..3 {
            let expected = tensors.tensor(&format!("{number}.output")).unwrap();
            let &[height, width, 3] = expected.shape() else { panic!("{:?}", expected.shape()) };
            let file = tensors.tensor(&format!("{number}.jpeg")).unwrap().data();
            // The frame header's sampling of the luma: 2 x 2, so that decoders have to enlarge the chroma (4:2:0).
            let header = file.windows(2).position(|marker| marker == [0xff, 0xc0]).unwrap();
            assert_eq!(file[header + 11], 0x22);
            let frame = decode(file, "k", 0).unwrap();
            let (fitted, _) = fit(&frame, norm, width, height, false).unwrap();
            let differences = fitted.rgb.iter().zip(expected.data()).map(|(a, b)| a.abs_diff(*b));
            let mean = differences.clone().map(f64::from).sum::<f64>() / fitted.rgb.len() as f64;
            // Decoders enlarge the chroma differently; of real photos the mean is 0.07 to 0.28 (docs/contributing.md).
            assert!(mean < 0.5 && differences.max() <= Some(8), "{number}: {mean}");
        }
    }
}
