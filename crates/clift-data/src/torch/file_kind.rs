//! Recognition of files that are not written by `torch.save`, with the remedy.

use std::path::Path;

use crate::error::DataError;
use crate::files::bounded::read_start;

const NUM_BYTES: u64 = 512;
/// Magic number at the start of the files of `torch.save` before `PyTorch` 1.6, in a pickle of any protocol.
const LEGACY: &[u8] = b"\x8a\x0al\xfc\x9cF\xf9 j\xa8P\x19.";
const MAX_LEGACY_START: usize = 16;

pub(crate) fn require_file(path: &Path) -> Result<(), DataError> {
    let bad = |what: &str| Err(DataError::BadCheckpoint { what: what.into(), path: path.to_path_buf() });
    let opening = "opening the checkpoint";
    let metadata = std::fs::metadata(path).map_err(DataError::io(opening, path))?;
    if metadata.is_dir() && path.join("model.safetensors").exists() {
        return bad("a model directory of clift, which needs no import");
    }
    if metadata.is_dir() {
        return bad("a directory; give the checkpoint file in it");
    }
    // Opening a pipe would block.
    if !metadata.is_file() {
        return bad("a pipe or a device, no regular file; give a file");
    }
    Ok(())
}

/// Returns a description of a file that is not a ZIP archive; `None` if the format is unknown or a ZIP archive.
pub(crate) fn other_format(path: &Path) -> Option<&'static str> {
    let (start, num_bytes) = (read_start(path, NUM_BYTES)?, std::fs::metadata(path).ok()?.len());
    let text = start.trim_ascii_start().to_ascii_lowercase();
    if start.is_empty() {
        return Some("an empty file; download it again");
    }
    let first = &start[..start.len().min(MAX_LEGACY_START + LEGACY.len())];
    if first.starts_with(b"\x80") && first.windows(LEGACY.len()).any(|part| part == LEGACY) {
        return Some(
            "written by torch.save in the format from before PyTorch 1.6; convert it in Python: \
             torch.save(torch.load(\"OLD\", map_location=\"cpu\"), \"NEW\") (weights_only=False executes code of the file: \
             use it only for files that you trust)",
        );
    }
    if matches!(start[..], [0x80, 2..=5, ..]) {
        return Some("a plain pickle, not written by torch.save; load it in Python and torch.save its state dict");
    }
    let header = start.first_chunk().map(|length| u64::from_le_bytes(*length));
    if start.get(8) == Some(&b'{') && header.is_some_and(|length| length < num_bytes) {
        return Some(
            "a safetensors file; convert it in Python: torch.save({\"state_dict\": safetensors.torch.load_file(\"OLD\")}, \
             \"NEW.ckpt\")",
        );
    }
    if ["<!doctype", "<html", "<?xml", "<head"].iter().any(|tag| text.starts_with(tag.as_bytes())) {
        return Some("a web page: the download returned an error or a sign-in page; download the file itself");
    }
    if text.starts_with(b"version https://git-lfs") {
        return Some("a Git LFS pointer; fetch the file with `git lfs pull`");
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::torch::archive::Archive;

    #[test]
    fn other_formats_are_named_with_the_remedy() {
        let root = tempfile::tempdir().unwrap();
        let path = root.path().join("a.ckpt");
        let safetensors = [&9_u64.to_le_bytes()[..], b"{\"a\": {}}"].concat();
        for (bytes, what) in [
            (&b""[..], "an empty file"),
            (&[b"\x80\x04\x95\x0d\0\0\0\0\0\0\0", LEGACY].concat(), "before PyTorch 1.6"),
            (b"\x80\x04\x95\x00", "a plain pickle"),
            (&safetensors, "a safetensors file"),
            (b"\n<!DOCTYPE html><html>", "a web page"),
            (b"version https://git-lfs.github.com/spec/v1\n", "git lfs pull"),
        ] {
            std::fs::write(&path, bytes).unwrap();
            let message = Archive::open(&path).err().unwrap().to_string();
            assert!(message.contains(what) && message.ends_with("a.ckpt"), "{message}");
            assert!(!message.contains("truncated"), "{message}");
        }
        // A truncated ZIP archive, and unknown formats.
        for bytes in [&b"PK\x03\x04...."[..], b"P", b"something else"] {
            std::fs::write(&path, bytes).unwrap();
            let message = Archive::open(&path).err().unwrap().to_string();
            assert!(message.contains("perhaps truncated"), "{message}");
        }
        let refused = |path: &Path| require_file(path).unwrap_err().to_string();
        assert!(refused(root.path()).contains("a directory; give the checkpoint file in it"));
        std::fs::write(root.path().join("model.safetensors"), "").unwrap();
        assert!(refused(root.path()).contains("needs no import"));
        #[cfg(unix)] // a pipe would block
        assert!(refused(Path::new("/dev/zero")).contains("no regular file"));
    }
}
