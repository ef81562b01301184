//! RealEstate10K as it is published: a text file of cameras per clip, with frames that the user has extracted.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use crate::error::DataError;
use crate::files::bounded::read_bounded;
use crate::geometry::camera::Camera;
use crate::sources::photos::image_folder::numbered_pictures;
use crate::sources::photos::photo::{MAX_FRAMES, MissingPhoto, Photo, PhotoScene};

/// Most bytes of one file: a hundred times those of the longest clip.
const MAX_BYTES: u64 = 16 << 20;
/// Most characters of a video's address that are kept.
const MAX_URL_CHARS: usize = 1000;
/// Columns of a line: a time stamp, four intrinsics, two zeros and a pose of 3 x 4.
const NUM_COLUMNS: usize = 19;

/// Reads the cameras of a clip and finds their frames, whose names are the time stamps. Frames are in the order of
/// the file.
///
/// # Errors
/// [`DataError::Io`], and [`DataError::BadScene`] that names the line.
pub(crate) fn read_re10k_text(path: &Path, frames: &Path) -> Result<PhotoScene, DataError> {
    let pictures = if frames.is_dir() { numbered_pictures(frames)? } else { HashMap::new() };
    let text = read_bounded(path, MAX_BYTES, "reading the cameras")?;
    let text = String::from_utf8(text)
        .map_err(|_| DataError::BadScene { what: "the file is not UTF-8".into(), path: path.to_owned() })?;
    parse(&text, &pictures).map_err(|what| DataError::BadScene { what, path: path.to_owned() })
}

fn parse(text: &str, pictures: &HashMap<i64, PathBuf>) -> Result<PhotoScene, String> {
    let mut scene = PhotoScene::default();
    let mut last = i64::MIN;
    for (number, line) in text.lines().enumerate() {
        // The first line is the address of the video; some tools leave it out.
        let is_address = number == 0 && line.split_ascii_whitespace().count() < NUM_COLUMNS;
        if is_address {
            scene.url = line.trim().chars().take(MAX_URL_CHARS).collect();
        }
        if line.trim().is_empty() || is_address {
            continue;
        }
        let in_line = |what: String| format!("line {}: {what}", number + 1);
        let (time, camera) = parse_line(line).map_err(in_line)?;
        if time <= last {
            return Err(in_line(format!("the time stamp {time} does not come after the one above, {last}")));
        }
        last = time;
        if scene.photos.len() + scene.missing.len() == MAX_FRAMES {
            return Err(in_line(format!("more than {MAX_FRAMES} frames")));
        }
        match pictures.get(&time) {
            Some(path) => {
                scene.photos.push(Photo {
                    path: path.clone(),
                    camera,
                    undistortion: None,
                    shape: None,
                    time: Some(time),
                });
            }
            None => scene.missing.push(MissingPhoto { name: time.to_string(), reason: "without a picture".into() }),
        }
    }
    // Time stamps rise, so that no picture is counted twice.
    scene.num_without_camera = pictures.len() - scene.photos.len();
    Ok(scene)
}

fn parse_line(line: &str) -> Result<(i64, Camera), String> {
    let words: Vec<&str> = line.split_ascii_whitespace().take(NUM_COLUMNS + 1).collect();
    if words.len() != NUM_COLUMNS {
        let more = if words.len() > NUM_COLUMNS { "more" } else { &words.len().to_string() };
        return Err(format!("expected {NUM_COLUMNS} columns, got {more}"));
    }
    let time = words[0].parse().map_err(|_| format!("the time stamp is {:?}, expected a whole number", words[0]))?;
    let mut row = [0.0; 18];
    for (value, word) in row.iter_mut().zip(&words[1..]) {
        *value = word.parse().map_err(|_| format!("{word:?} is no number"))?;
    }
    Camera::from_re10k(row).map(|camera| (time, camera)).map_err(|error| error.to_string())
}

/// Whether a text file begins as such a file does: its first or second line is a camera.
pub(crate) fn looks_like_re10k(path: &Path) -> bool {
    use std::io::Read;
    let is_file = std::fs::metadata(path).is_ok_and(|metadata| metadata.is_file());
    let Some(file) = is_file.then(|| std::fs::File::open(path).ok()).flatten() else { return false };
    let mut head = Vec::new();
    if file.take(4096).read_to_end(&mut head).is_err() {
        return false;
    }
    String::from_utf8_lossy(&head).lines().take(2).any(|line| parse_line(line).is_ok())
}
