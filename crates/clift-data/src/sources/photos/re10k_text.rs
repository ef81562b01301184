//! RealEstate10K as published: one text file of cameras per clip; the frames are extracted by the user.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use clift_core::{Camera, IntrinsicsNorm};

use crate::error::DataError;
use crate::files::bounded::{read_bounded, read_start};
use crate::sources::photos::image_folder::numbered_images;
use crate::sources::photos::photo::{MAX_FRAMES, NO_IMAGE, Photo, PhotoScene};

/// Largest size of a file, in bytes: a hundred times the longest clip.
const MAX_BYTES: u64 = 16 << 20;
const MAX_URL_CHARS: usize = 1000;
/// Number of columns of a line: a time stamp, four intrinsics, two zeros and a pose of 3 x 4.
const NUM_COLUMNS: usize = 19;

/// Reads the cameras of a clip and locates the frames, which are named by time stamp. Frames are in the order of the file.
pub(crate) fn read_re10k_text(path: &Path, frames: &Path) -> Result<PhotoScene, DataError> {
    let images = if frames.is_dir() { numbered_images(frames)? } else { HashMap::new() };
    let text = read_bounded(path, MAX_BYTES, "reading the cameras")?;
    let text = String::from_utf8(text)
        .map_err(|_| DataError::BadScene { what: "the file is not UTF-8".into(), path: path.to_owned() })?;
    parse(text.trim_start_matches('\u{feff}'), &images)
        .map_err(|what| DataError::BadScene { what, path: path.to_owned() })
}

fn parse(text: &str, images: &HashMap<i64, PathBuf>) -> Result<PhotoScene, String> {
    let mut scene = PhotoScene::default();
    let mut last = i64::MIN;
    for (number, line) in text.lines().enumerate() {
        // The first line is the URL of the video; some tools omit it.
        let is_url = number == 0 && line.split_ascii_whitespace().count() < NUM_COLUMNS;
        if is_url {
            scene.url = line.trim().chars().take(MAX_URL_CHARS).collect();
        }
        if line.trim().is_empty() || is_url {
            continue;
        }
        let in_line = |what: String| format!("line {}: {what}", number + 1);
        let (time, camera) = parse_line(line).map_err(in_line)?;
        if time <= last {
            return Err(in_line(format!("the time stamp {time} does not exceed the previous one, {last}")));
        }
        last = time;
        if scene.photos.len() + scene.missing.len() == MAX_FRAMES {
            return Err(in_line(format!("more than {MAX_FRAMES} frames")));
        }
        match images.get(&time) {
            Some(path) => {
                let (path, time) = (path.clone(), Some(time));
                scene.photos.push(Photo { path, camera, undistortion: None, shape: None, mask: None, time });
            }
            None => scene.skip(time.to_string(), NO_IMAGE),
        }
    }
    // Time stamps increase, so that no image is counted twice.
    scene.num_without_camera = images.len() - scene.photos.len();
    Ok(scene)
}

fn parse_line(line: &str) -> Result<(i64, Camera<IntrinsicsNorm>), String> {
    let words: Vec<&str> = line.split_ascii_whitespace().take(NUM_COLUMNS + 1).collect();
    if words.len() != NUM_COLUMNS {
        let more = if words.len() > NUM_COLUMNS { "more" } else { &words.len().to_string() };
        return Err(format!("expected {NUM_COLUMNS} columns, got {more}"));
    }
    let time = words[0].parse().map_err(|_| format!("the time stamp is {:?}, expected a whole number", words[0]))?;
    let mut row = [0.0; 18];
    for (value, word) in row.iter_mut().zip(&words[1..]) {
        *value = word.parse().map_err(|_| format!("expected a number, got {word:?}"))?;
    }
    Camera::from_re10k(row).map(|camera| (time, camera)).map_err(|error| error.to_string())
}

/// Returns whether the first or second line of a text file is a camera of RealEstate10K.
pub(crate) fn looks_like_re10k(path: &Path) -> bool {
    let Some(start) = read_start(path, 4096) else { return false };
    String::from_utf8_lossy(&start).lines().take(2).any(|line| parse_line(line).is_ok())
}
