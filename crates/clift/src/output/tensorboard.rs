//! TensorBoard's event files: scalars over steps.
//!
//! A record is its length as u64, the masked CRC-32C of the length, the data, and the masked CRC-32C of the data, all
//! little-endian. The data is a protocol buffer `Event`: `wall_time` = 1 (double), `step` = 2 (int64), `file_version`
//! = 3 (string), `summary` = 5, which holds values = 1 with `tag` = 1 (string) and `simple_value` = 2 (float).

/// A value of a curve.
pub struct Scalar<'a> {
    pub tag: &'a str,
    /// Step from 1.
    pub step: u64,
    /// Seconds since 1970.
    pub time: f64,
    pub value: f64,
}

/// Returns the bytes of an event file that begins at `time`, in seconds since 1970.
pub fn event_file<'a>(time: f64, scalars: impl Iterator<Item = Scalar<'a>>) -> Vec<u8> {
    let mut file = Vec::new();
    let mut version = double(1, time);
    version.extend(bytes(3, b"brain.Event:2"));
    record(&mut file, &version);
    for Scalar { tag, step, time, value } in scalars {
        let mut scalar = bytes(1, tag.as_bytes());
        scalar.push(2 << 3 | 5);
        scalar.extend((value as f32).to_le_bytes());
        let mut event = double(1, time);
        event.push(2 << 3);
        event.extend(varint(step));
        event.extend(bytes(5, &bytes(1, &scalar)));
        record(&mut file, &event);
    }
    file
}

fn record(file: &mut Vec<u8>, data: &[u8]) {
    let length = (data.len() as u64).to_le_bytes();
    file.extend(length);
    file.extend(masked_crc(&length).to_le_bytes());
    file.extend(data);
    file.extend(masked_crc(data).to_le_bytes());
}

fn masked_crc(data: &[u8]) -> u32 {
    crc32c::crc32c(data).rotate_right(15).wrapping_add(0xa282_ead8)
}

/// A field of type double.
fn double(field: u8, value: f64) -> Vec<u8> {
    let mut bytes = vec![field << 3 | 1];
    bytes.extend(value.to_le_bytes());
    bytes
}

/// A field of bytes: a string or a message.
fn bytes(field: u8, value: &[u8]) -> Vec<u8> {
    let mut bytes = vec![field << 3 | 2];
    bytes.extend(varint(value.len() as u64));
    bytes.extend(value);
    bytes
}

fn varint(mut value: u64) -> Vec<u8> {
    let mut bytes = Vec::new();
    while value >= 0x80 {
        bytes.push(value as u8 | 0x80);
        value >>= 7;
    }
    bytes.push(value as u8);
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_are_those_of_tensorboard() {
        // What `tf.summary` writes for the version record at time 0, up to its checksum.
        let scalar = Scalar { tag: "loss", step: 300, time: 1.5, value: 0.25 };
        let file = event_file(0.0, [scalar].into_iter());
        let version = b"\x09\0\0\0\0\0\0\0\0\x1a\x0dbrain.Event:2";
        assert_eq!(file[..8], (version.len() as u64).to_le_bytes());
        assert_eq!(file[12..12 + version.len()], version[..]);
        let event = &file[12 + version.len() + 4..];
        let data = b"\x09\0\0\0\0\0\0\xf8\x3f\x10\xac\x02\x2a\x0d\x0a\x0b\x0a\x04loss\x15\0\0\x80\x3e";
        assert_eq!(event[..8], (data.len() as u64).to_le_bytes());
        assert_eq!(event[12..12 + data.len()], data[..]);
        assert_eq!(event.len(), 12 + data.len() + 4);
        // The check value of CRC-32C, and the mask of it.
        assert_eq!(crc32c::crc32c(b"123456789"), 0xe306_9283);
        assert_eq!(masked_crc(b"123456789"), 0xe306_9283_u32.rotate_right(15).wrapping_add(0xa282_ead8));
    }
}
