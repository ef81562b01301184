//! The ZIP archive of `torch.save`. Its members are uncompressed, so that each can be read on its own; byte ranges of tensors.

use std::collections::HashMap;
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::Path;

use zip::{CompressionMethod, ZipArchive};

use crate::error::DataError;
use crate::torch::file_kind::{other_format, require_file};
use crate::torch::values::{ElementType, MAX_BYTES, Tensor, Value};

/// Byte range of a member of an archive, or of a part of a member. It takes 24 bytes, because a data set has millions.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ByteSpan {
    /// Start of the member's local header in the file. The start of its data is read from the header on use: reading all
    /// headers at opening would touch every page of every chunk.
    header_start: u64,
    start: u32,
    length: u32,
    /// Checksum of the whole member; 0 for a part, and where checksums are switched off.
    crc32: u32,
}

impl ByteSpan {
    pub fn len(&self) -> u64 {
        u64::from(self.length)
    }

    /// Returns the part of `length` bytes from `start` of a whole member; `None` if it exceeds the member.
    pub fn part(self, start: u64, length: u64) -> Option<Self> {
        if start == 0 && length == self.len() {
            return Some(self);
        }
        let end = start.checked_add(length)?;
        (end <= self.len()).then_some(Self { start: start as u32, length: length as u32, crc32: 0, ..self })
    }

    pub fn read(&self, path: &Path) -> Result<Vec<u8>, DataError> {
        let bad = |what: &str| DataError::BadChunk {
            what: format!("the member at byte {} {what}; download the file again", self.header_start),
            path: path.to_path_buf(),
        };
        let mut file = File::open(path).map_err(DataError::io("opening the chunk", path))?;
        let mut header = [0; 30]; // "PK\3\4" first, the lengths of name and extra field last
        file.seek(SeekFrom::Start(self.header_start)).map_err(DataError::io("reading the chunk", path))?;
        file.read_exact(&mut header).map_err(|_| bad("lies behind the end of the file"))?;
        if header[..4] != *b"PK\x03\x04" {
            return Err(bad("has no local header"));
        }
        let length_at = |at: usize| u64::from(u16::from_le_bytes([header[at], header[at + 1]]));
        let data_start = self.header_start + 30 + length_at(26) + length_at(28) + u64::from(self.start);
        file.seek(SeekFrom::Start(data_start)).map_err(DataError::io("reading the chunk", path))?;
        // Bounded by the size of the file: `Archive::open` checks the length.
        let mut bytes = vec![0; self.length as usize];
        file.read_exact(&mut bytes).map_err(|_| bad("lies behind the end of the file"))?;
        if self.crc32 != 0 && crc32fast::hash(&bytes) != self.crc32 {
            return Err(bad("has another checksum than the directory of the archive"));
        }
        Ok(bytes)
    }
}

pub(crate) struct Archive {
    members: HashMap<String, ByteSpan>,
}

impl Archive {
    /// Reads the directory. Member names are stored without the top folder: `data.pkl`, `data/0`.
    pub fn open(path: &Path) -> Result<Self, DataError> {
        let bad = |what: String| DataError::BadChunk { what, path: path.to_path_buf() };
        require_file(path)?;
        let file = File::open(path).map_err(DataError::io("opening the chunk", path))?;
        let file_bytes = file.metadata().map_err(DataError::io("opening the chunk", path))?.len();
        let archive = ZipArchive::new(BufReader::new(file)).map_err(|error| {
            bad(other_format(path).map_or_else(
                || format!("the file of {file_bytes} bytes is not a readable ZIP archive, perhaps truncated ({error})"),
                str::to_owned,
            ))
        })?;
        let mut members = HashMap::with_capacity(archive.len());
        for index in 0..archive.len() {
            let entry = archive.by_index_data(index).map_err(|error| bad(error.to_string()))?;
            let raw_name = entry.name().map_err(|error| bad(error.to_string()))?;
            let name = raw_name.split_once('/').map_or(&*raw_name, |(_, name)| name);
            if entry.compression() != CompressionMethod::Stored || entry.encrypted() {
                return Err(bad(format!("member {name} is compressed, expected the stored members of torch.save")));
            }
            let length = u32::try_from(entry.size()).map_err(|_| bad(format!("member {name} exceeds 4 GiB")))?;
            if entry.header_start().saturating_add(entry.size()) > file_bytes {
                return Err(bad(format!("member {name} lies behind the end of the file")));
            }
            let span = ByteSpan { header_start: entry.header_start(), start: 0, length, crc32: entry.crc32() };
            members.insert(name.to_owned(), span);
        }
        let archive = Self { members };
        if let Some(order) = archive.member("byteorder") {
            let order = order.read(path)?;
            if order != b"little" {
                return Err(bad(format!("byte order {:?}, expected little", String::from_utf8_lossy(&order))));
            }
        }
        Ok(archive)
    }

    pub fn read_pickle(&self, path: &Path) -> Result<Vec<u8>, DataError> {
        let bad = |what: String| DataError::BadChunk { what, path: path.to_path_buf() };
        let member = self
            .member("data.pkl")
            .ok_or_else(|| bad("no member data.pkl: the file was not written by torch.save".into()))?;
        if member.len() > MAX_BYTES as u64 {
            return Err(bad(format!("data.pkl has {} bytes, more than the limit of {MAX_BYTES}", member.len())));
        }
        member.read(path)
    }

    /// Returns whether the file was written without checksums, as after `torch.serialization.set_crc32_options(False)`.
    pub fn lacks_checksums(&self) -> bool {
        self.members.values().all(|member| member.crc32 == 0)
    }

    pub fn member(&self, name: &str) -> Option<ByteSpan> {
        self.members.get(name).copied()
    }
}

/// Returns the byte range of a tensor, after checks of type, shape (`None` is any size), layout and bounds.
pub(crate) fn tensor_span(
    value: &Value,
    shape: &[Option<u64>],
    element_types: &[ElementType],
    archive: &Archive,
) -> Result<(ByteSpan, ElementType), String> {
    let Value::Tensor(tensor) = value else { return Err("no tensor".into()) };
    let Tensor { storage, offset, .. } = &**tensor;
    let element_type = storage.element_type;
    if !element_types.contains(&element_type) {
        return Err(format!("elements are {element_type:?}, expected one of {element_types:?}"));
    }
    let matches = tensor.shape.len() == shape.len()
        && tensor.shape.iter().zip(shape).all(|(got, expected)| expected.is_none_or(|expected| *got == expected));
    if !matches {
        let expected: Vec<_> = shape.iter().map(|size| size.map_or("any".into(), |size| size.to_string())).collect();
        return Err(format!("shape is {:?}, expected [{}]", tensor.shape, expected.join(", ")));
    }
    if !tensor.is_contiguous() {
        return Err(format!(
            "stride is {:?}, expected a contiguous tensor; save it as tensor.contiguous()",
            tensor.stride
        ));
    }
    let member = archive
        .member(&format!("data/{}", storage.key))
        .ok_or_else(|| format!("its storage data/{} is not in the archive", storage.key))?;
    let size = element_type.num_bytes();
    let span = tensor
        .shape
        .iter()
        .try_fold(size, |product, size| product.checked_mul(*size))
        .zip(offset.checked_mul(size))
        .and_then(|(length, start)| member.part(start, length))
        .ok_or_else(|| {
            format!("shape {:?} at offset {offset} exceeds its storage of {} bytes", tensor.shape, member.len())
        })?;
    Ok((span, element_type))
}
