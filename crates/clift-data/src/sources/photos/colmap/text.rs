//! COLMAP text files, line by line.

use std::fs::File;
use std::io::{BufRead, BufReader, Read};
use std::path::Path;
use std::str::FromStr;

use crate::error::DataError;
use crate::files::listing::decode_name;
use crate::sources::photos::colmap::model::{ColmapCamera, ColmapImage, MAX_NAME_BYTES, Model};

/// Largest number of stored bytes of a line; lines of points may be longer, and their rest is skipped.
const MAX_LINE_BYTES: usize = MAX_NAME_BYTES + 1024;

/// Reads `cameras.txt`.
pub(crate) fn read_cameras(path: &Path, read: &mut Model) -> Result<(), DataError> {
    let mut lines = Lines::open(path)?;
    while let Some(line) = lines.next_entry()? {
        let mut words = line.split_ascii_whitespace();
        // No image can use a camera without an id.
        let Ok(id) = number(words.next(), "CAMERA_ID") else { continue };
        let camera = (|| {
            let model = words.next().ok_or("no MODEL")?.to_owned();
            let (width, height) = (number(words.next(), "WIDTH")?, number(words.next(), "HEIGHT")?);
            // Programs write NaN in many ways, such as `-nan(ind)`.
            let params = words.map(|word| word.parse().unwrap_or(f64::NAN)).collect();
            Ok(ColmapCamera { model, width, height, params })
        })();
        let camera = camera.map_err(|what: String| format!("line {}: {what}", lines.number));
        read.add_camera(id, camera).map_err(|what| lines.bad(&what))?;
    }
    Ok(())
}

/// Reads `images.txt`.
pub(crate) fn read_images(path: &Path, read: &mut Model) -> Result<(), DataError> {
    let mut lines = Lines::open(path)?;
    while let Some(line) = lines.next_entry()? {
        let image = parse_image(&line).map_err(|what| {
            let name = line.splitn(10, ' ').nth(9).map(str::to_owned);
            (name.unwrap_or_else(|| format!("line {}", lines.number)), format!("whose line is malformed: {what}"))
        });
        read.add_image(image).map_err(|what| lines.bad(&what))?;
        // The line of points may be empty, but an image line in its place is an error: its numbers form a unit quaternion.
        if lines.next_line()? && parse_image(&decode_name(&lines.line)).is_ok_and(|image| image.c2w().is_ok()) {
            return Err(
                lines.bad("expected the points of the image above: two lines per image, the second may be empty")
            );
        }
    }
    Ok(())
}

/// Counts the images of `images.txt`; 0 for an unreadable file.
pub(crate) fn num_images(path: &Path) -> u64 {
    let count = || {
        let (mut lines, mut count) = (Lines::open(path)?, 0);
        while lines.next_entry()?.is_some() {
            (count, _) = (count + 1, lines.next_line()?);
        }
        Ok::<u64, DataError>(count)
    };
    count().unwrap_or_default()
}

fn parse_image(line: &str) -> Result<ColmapImage, String> {
    let mut rest = line.trim();
    let mut word = |what: &str| {
        let (first, after) = rest.split_once(|c: char| c.is_ascii_whitespace()).unwrap_or((rest, ""));
        rest = after.trim_start();
        if first.is_empty() { Err(format!("no {what}")) } else { Ok(first.to_owned()) }
    };
    let _: u32 = number(Some(&word("IMAGE_ID")?), "IMAGE_ID")?;
    let mut w2c = [0.0; 7];
    for (value, name) in w2c.iter_mut().zip(["QW", "QX", "QY", "QZ", "TX", "TY", "TZ"]) {
        *value = word(name)?.parse().unwrap_or(f64::NAN);
    }
    let camera_id = number(Some(&word("CAMERA_ID")?), "CAMERA_ID")?;
    if rest.is_empty() || rest.len() > MAX_NAME_BYTES {
        return Err(format!("the NAME has {} bytes", rest.len()));
    }
    Ok(ColmapImage { name: rest.into(), camera_id, w2c })
}

fn number<T: FromStr>(word: Option<&str>, name: &str) -> Result<T, String> {
    let word = word.ok_or_else(|| format!("no {name}"))?;
    word.parse().map_err(|_| format!("{name} is {word:?}, expected a number"))
}

/// Lines of a file, truncated to [`MAX_LINE_BYTES`].
struct Lines<'a> {
    path: &'a Path,
    reader: BufReader<File>,
    line: Vec<u8>,
    number: usize,
}

impl<'a> Lines<'a> {
    fn open(path: &'a Path) -> Result<Self, DataError> {
        let file = File::open(path).map_err(DataError::io("opening a COLMAP model", path))?;
        Ok(Self { path, reader: BufReader::new(file), line: Vec::new(), number: 0 })
    }

    fn bad(&self, what: &str) -> DataError {
        DataError::BadScene { what: format!("line {}: {what}", self.number), path: self.path.to_owned() }
    }

    /// Reads the next line; false at the end of the file.
    fn next_line(&mut self) -> Result<bool, DataError> {
        let io = DataError::io("reading a COLMAP model", self.path);
        self.line.clear();
        self.number += 1;
        let mut limited = (&mut self.reader).take(MAX_LINE_BYTES as u64);
        let length = match limited.read_until(b'\n', &mut self.line) {
            Ok(length) => length,
            Err(error) => return Err(io(error)),
        };
        if length == MAX_LINE_BYTES && self.line.last() != Some(&b'\n') {
            self.reader.skip_until(b'\n').map_err(io)?;
        }
        Ok(length > 0)
    }

    /// Reads the next line that is neither empty nor a comment.
    fn next_entry(&mut self) -> Result<Option<String>, DataError> {
        while self.next_line()? {
            let line = self.line.trim_ascii();
            if line.is_empty() || line.starts_with(b"#") {
                continue;
            }
            if self.line.len() == MAX_LINE_BYTES {
                return Err(self.bad("the line is too long"));
            }
            return Ok(Some(decode_name(line)));
        }
        Ok(None)
    }
}
