//! The SHA-256 of a file.

use std::fs::File;
use std::io::Read;
use std::path::Path;

use sha2::{Digest, Sha256};

use crate::error::DataError;

/// Returns the SHA-256 of a file in hexadecimal.
pub fn hash_file(path: &Path) -> Result<String, DataError> {
    let reading = || DataError::io("reading a file for its checksum", path);
    let mut file = File::open(path).map_err(reading())?;
    let mut digest = Sha256::new();
    let mut buffer = vec![0; 1 << 20];
    loop {
        match file.read(&mut buffer).map_err(reading())? {
            0 => break,
            count => digest.update(&buffer[..count]),
        }
    }
    Ok(hex::encode(digest.finalize()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::read_from_file;

    #[test]
    fn hashes_are_sha256() {
        let hash = read_from_file("a", "abc", hash_file).unwrap();
        assert_eq!(hash, "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad");
    }
}
