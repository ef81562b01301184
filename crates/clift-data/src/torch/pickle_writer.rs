//! Files for `torch.load`: a pickle of protocol 2 and its storages in a ZIP archive.

use std::io::{Cursor, Write};

use zip::result::ZipResult;
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipWriter};

pub(crate) struct PickleWriter {
    bytes: Vec<u8>,
    storages: Vec<Vec<u8>>,
}

impl PickleWriter {
    pub fn new() -> Self {
        Self { bytes: b"\x80\x02".to_vec(), storages: Vec::new() }
    }

    /// Writes a contiguous tensor that fills a new storage.
    pub fn tensor(&mut self, storage_type: &str, storage: Vec<u8>, shape: &[usize]) {
        let stride: Vec<usize> = (0..shape.len()).map(|dimension| shape[dimension + 1..].iter().product()).collect();
        self.strided_tensor(storage_type, storage, shape, &stride);
    }

    /// Writes a tensor that starts at the first element of a new storage.
    pub fn strided_tensor(&mut self, storage_type: &str, storage: Vec<u8>, shape: &[usize], stride: &[usize]) {
        self.raw(b"ctorch._utils\n_rebuild_tensor_v2\n((");
        self.string("storage");
        self.raw(format!("ctorch\n{storage_type}\n").as_bytes());
        self.string(&self.storages.len().to_string());
        self.string("cpu");
        self.integer(shape.iter().fold(1, |product, size| product.wrapping_mul(*size)));
        self.raw(b"tQ");
        self.integer(0); // offset
        self.raw(b"(");
        for size in shape {
            self.integer(*size);
        }
        self.raw(b"t(");
        for step in stride {
            self.integer(*step);
        }
        self.raw(b"t\x89ccollections\nOrderedDict\n)RtR"); // requires no gradient, has no hooks
        self.storages.push(storage);
    }

    pub fn string(&mut self, text: &str) {
        self.raw(b"X");
        self.raw(&(text.len() as u32).to_le_bytes());
        self.raw(text.as_bytes());
    }

    /// Writes an integer as LONG1 with eight bytes, for every size.
    pub fn integer(&mut self, value: usize) {
        self.raw(&[0x8a, 8]);
        self.raw(&(value as u64).to_le_bytes());
    }

    pub fn raw(&mut self, bytes: &[u8]) {
        self.bytes.extend_from_slice(bytes);
    }

    #[cfg(test)]
    pub fn pickle(&self) -> &[u8] {
        &self.bytes
    }

    /// Returns the archive of pickle and storages, uncompressed, aligned to 64 bytes, with the top folder `prefix`.
    pub fn pack(self, prefix: &str) -> ZipResult<Vec<u8>> {
        let options = SimpleFileOptions::default().compression_method(CompressionMethod::Stored);
        let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
        let mut member = |name: &str, alignment: u16, bytes: &[u8]| {
            zip.start_file(format!("{prefix}/{name}"), options.with_alignment(alignment))?;
            zip.write_all(bytes)?;
            ZipResult::Ok(())
        };
        member("data.pkl", 1, &self.bytes)?;
        member("byteorder", 1, b"little")?;
        for (number, storage) in self.storages.iter().enumerate() {
            member(&format!("data/{number}"), 64, storage)?;
        }
        member("version", 1, b"3\n")?;
        Ok(zip.finish()?.into_inner())
    }
}
