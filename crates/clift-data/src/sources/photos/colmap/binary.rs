//! COLMAP binary files, little-endian.

use std::fs::File;
use std::io::{BufReader, Read};
use std::path::Path;

use crate::error::DataError;
use crate::files::listing::decode_name;
use crate::geometry::lens::MODELS;
use crate::sources::photos::colmap::model::{ColmapCamera, ColmapImage, MAX_NAME_BYTES, Model};

/// Bytes of an image point: two coordinates and the id of the 3D point.
const POINT_BYTES: u64 = 24;

/// Reads `cameras.bin`.
pub(crate) fn read_cameras(path: &Path, read: &mut Model) -> Result<(), DataError> {
    let mut file = Fields::open(path)?;
    let count = u64::from_le_bytes(file.take()?);
    for index in 0..count {
        let id = u32::from_le_bytes(file.take()?);
        let model = i32::from_le_bytes(file.take()?);
        let (width, height) = (u64::from_le_bytes(file.take()?), u64::from_le_bytes(file.take()?));
        // Of an unknown model the number of parameters is unknown, thus where the next camera begins.
        let &(name, num_focal, num_distortion) = usize::try_from(model)
            .ok()
            .and_then(|model| MODELS.get(model))
            .ok_or_else(|| file.bad(format!("camera {index} of {count} has the unknown model {model}")))?;
        let params = (0..num_focal + 2 + num_distortion).map(|_| file.take().map(f64::from_le_bytes));
        let camera = ColmapCamera { model: name.into(), width, height, params: params.collect::<Result<_, _>>()? };
        read.add_camera(id, Ok(camera)).map_err(|what| file.bad(what))?;
    }
    Ok(())
}

/// Reads `images.bin`.
pub(crate) fn read_images(path: &Path, read: &mut Model) -> Result<(), DataError> {
    let mut file = Fields::open(path)?;
    let count = u64::from_le_bytes(file.take()?);
    for _ in 0..count {
        let _id: [u8; 4] = file.take()?;
        let mut w2c = [0.0; 7];
        for value in &mut w2c {
            *value = f64::from_le_bytes(file.take()?);
        }
        let camera_id = u32::from_le_bytes(file.take()?);
        let name = file.take_name()?;
        let num_points = u64::from_le_bytes(file.take()?);
        file.skip(num_points.checked_mul(POINT_BYTES))?;
        read.add_image(Ok(ColmapImage { name, camera_id, w2c })).map_err(|what| file.bad(what))?;
    }
    Ok(())
}

/// Reads the number of images of `images.bin`; 0 for an unreadable file.
pub(crate) fn num_images(path: &Path) -> u64 {
    Fields::open(path).and_then(|mut file| file.take()).map(u64::from_le_bytes).unwrap_or_default()
}

/// Sequential fields of a file. Counts of the file reserve no memory.
struct Fields<'a> {
    path: &'a Path,
    reader: BufReader<File>,
    at: u64,
    num_bytes: u64,
}

impl<'a> Fields<'a> {
    fn open(path: &'a Path) -> Result<Self, DataError> {
        let file = File::open(path).map_err(DataError::io("opening a COLMAP model", path))?;
        let num_bytes = file.metadata().map_err(DataError::io("opening a COLMAP model", path))?.len();
        Ok(Self { path, reader: BufReader::new(file), at: 0, num_bytes })
    }

    fn bad(&self, what: String) -> DataError {
        DataError::BadScene { what, path: self.path.to_owned() }
    }

    /// Moves past `count` bytes; refuses to pass the end of the file.
    fn advance(&mut self, count: Option<u64>) -> Result<(), DataError> {
        let end = count.and_then(|count| self.at.checked_add(count)).filter(|end| *end <= self.num_bytes);
        self.at = end.ok_or_else(|| {
            let (at, num_bytes) = (self.at, self.num_bytes);
            self.bad(format!("the field at byte {at} exceeds the file of {num_bytes} bytes; the file is truncated"))
        })?;
        Ok(())
    }

    fn take<const N: usize>(&mut self) -> Result<[u8; N], DataError> {
        self.advance(Some(N as u64))?;
        let mut bytes = [0; N];
        self.reader.read_exact(&mut bytes).map_err(DataError::io("reading a COLMAP model", self.path))?;
        Ok(bytes)
    }

    fn take_name(&mut self) -> Result<String, DataError> {
        let mut name = Vec::new();
        loop {
            let [byte] = self.take()?;
            if byte == 0 {
                break;
            }
            name.push(byte);
            if name.len() > MAX_NAME_BYTES {
                return Err(self.bad(format!("the name before byte {} is longer than {MAX_NAME_BYTES} bytes", self.at)));
            }
        }
        Ok(decode_name(&name))
    }

    fn skip(&mut self, count: Option<u64>) -> Result<(), DataError> {
        self.advance(count)?;
        let count = i64::try_from(count.unwrap_or_default()).unwrap_or(i64::MAX);
        self.reader.seek_relative(count).map_err(DataError::io("reading a COLMAP model", self.path))
    }
}
