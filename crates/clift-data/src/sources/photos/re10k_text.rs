//! RealEstate10K as published: one text file of cameras per clip; the frames are extracted by the user.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use clift_core::plural;

use crate::error::DataError;
use crate::files::bounded::{read_bounded, read_start};
use crate::geometry::scaled_rotation::{ScaledCamera, camera_of_row, note_on_scales};
use crate::sources::photos::image_folder::images_in;
use crate::sources::photos::photo::{MAX_FRAMES, NO_IMAGE, Photo, PhotoScene, unusable};

/// Largest size of a file, in bytes: a hundred times the longest clip.
const MAX_BYTES: u64 = 16 << 20;
/// Number of columns of a line: a time stamp, four intrinsics, two zeros and a pose of 3 x 4.
const NUM_COLUMNS: usize = 19;

/// Reads the cameras of a clip and locates the frames, which are named by time stamp or are as many as the cameras. Frames
/// are in the order of the file.
pub(crate) fn read_re10k_text(path: &Path, frames: &Path) -> Result<PhotoScene, DataError> {
    let images = if frames.is_dir() { images_in(frames)? } else { Vec::new() };
    let bad = |what: String| DataError::BadScene { what, path: path.to_owned() };
    let text = read_bounded(path, MAX_BYTES, "reading the cameras")?;
    let text = String::from_utf8(text).map_err(|_| bad("the file is not UTF-8".into()))?;
    let lines = parse(text.trim_start_matches('\u{feff}')).map_err(bad)?;
    let times: Vec<i64> = lines.iter().map(|(time, _)| *time).collect();
    let (found, note) = locate(&times, &images);
    let mut scene = PhotoScene::default();
    scene.notes.extend(note.map(|note| format!("frames of {}: {note}", path.display())));
    let scales = lines.iter().filter_map(|(_, camera)| camera.as_ref().ok()?.1);
    scene.notes.extend(note_on_scales(scales, path));
    for ((time, camera), image) in lines.into_iter().zip(found) {
        match (image, camera) {
            (Some(path), Ok((camera, _))) => scene.photos.push(Photo::pinhole(path.clone(), camera)),
            (Some(_), Err(what)) => scene.skip(time.to_string(), unusable(&what)),
            (None, _) => scene.skip(time.to_string(), NO_IMAGE),
        }
    }
    Ok(scene)
}

/// Finds the image of every time stamp, with a note if the names are not the time stamps.
fn locate<'a>(times: &[i64], images: &'a [PathBuf]) -> (Vec<Option<&'a PathBuf>>, Option<String>) {
    let number = |path: &'a PathBuf| Some((path.file_stem()?.to_str()?.parse::<i64>().ok()?, path));
    // Of `77` and `077`, the first in order of names.
    let numbered: BTreeMap<i64, &PathBuf> = images.iter().rev().filter_map(number).collect();
    let exact: Vec<_> = times.iter().map(|time| numbered.get(time).copied()).collect();
    let num_exact = exact.iter().flatten().count();
    if num_exact == times.len().min(numbered.len()) && num_exact > 1 {
        return (exact, None);
    }
    // Half the smallest distance of frames: no two frames are nearest to one image.
    let step = times.windows(2).map(|pair| pair[1].saturating_sub(pair[0])).min().unwrap_or_default();
    let nearest = |time: &i64| {
        let range = time.saturating_sub((step - 1) / 2)..=time.saturating_add((step - 1) / 2);
        numbered.range(range).min_by_key(|(number, _)| number.abs_diff(*time)).map(|(_, path)| *path)
    };
    let near: Vec<_> = times.iter().map(|time| numbered.get(time).copied().or_else(|| nearest(time))).collect();
    let num_near = near.iter().flatten().count();
    if images.len() == times.len() && num_near <= times.len() / 2 {
        return (images.iter().map(Some).collect(), Some("the images are taken in the order of their names".into()));
    }
    let count = plural(num_near - num_exact, "image");
    let note = format!("the names of {count} differ from the time stamps, by less than half a frame");
    (near, (num_near > num_exact).then_some(note))
}

/// A time stamp with its camera, or why the camera cannot be used.
type Line = (i64, Result<ScaledCamera, String>);

fn parse(text: &str) -> Result<Vec<Line>, String> {
    let mut lines = Vec::<Line>::new();
    for (number, line) in text.lines().enumerate() {
        // The first line is the URL of the video; some tools omit it.
        let is_url = number == 0 && line.split_ascii_whitespace().count() < NUM_COLUMNS;
        if line.trim().is_empty() || is_url {
            continue;
        }
        let in_line = |what: String| format!("line {}: {what}", number + 1);
        let (time, camera) = parse_line(line).map_err(in_line)?;
        if let Some((last, _)) = lines.last().filter(|(last, _)| time <= *last) {
            return Err(in_line(format!("the time stamp {time} does not exceed the previous one, {last}")));
        }
        if lines.len() == MAX_FRAMES {
            return Err(in_line(format!("more than {MAX_FRAMES} frames")));
        }
        lines.push((time, camera));
    }
    Ok(lines)
}

/// Parses a line of the right form; words that are no numbers make the camera unusable.
fn parse_line(line: &str) -> Result<Line, String> {
    let words: Vec<&str> = line.split_ascii_whitespace().take(NUM_COLUMNS + 1).collect();
    if words.len() != NUM_COLUMNS {
        let more = if words.len() > NUM_COLUMNS { "more" } else { &words.len().to_string() };
        return Err(format!("expected {NUM_COLUMNS} columns, got {more}"));
    }
    let time = words[0].parse().map_err(|_| format!("the time stamp is {:?}, expected a whole number", words[0]))?;
    let mut row = [0.0; 18];
    for (value, word) in row.iter_mut().zip(&words[1..]) {
        *value = word.parse().unwrap_or(f64::NAN);
    }
    Ok((time, camera_of_row(row).map_err(|error| error.to_string())))
}

/// Returns whether the first or second line of a text file is a camera of RealEstate10K.
pub(crate) fn looks_like_re10k(path: &Path) -> bool {
    let Some(start) = read_start(path, 4096) else { return false };
    String::from_utf8_lossy(&start).lines().take(2).any(|line| parse_line(line).is_ok_and(|(_, camera)| camera.is_ok()))
}
