//! Damage in the middle of a JPEG file. Decoders draw a torn image and report nothing; here the Huffman codes of every scan of a
//! sequential file are followed without computing pixels, and must end with the data of the scan.

use image::ImageFormat;

use crate::image::codec::{MAX_SIDE, decode, known_format};

/// Bytes between the last block of a scan and the next marker that are accepted as padding of the writer.
const MAX_LEFT_OVER: usize = 16;

const ENDS_EARLY: &str = "the image data ends before its last block";
const LEFT_OVER: &str = "image data is left over after its last block";
const BAD_CODE: &str = "the image data has an invalid code";
const BAD_SEGMENT: &str = "a segment of the header is malformed";

/// Checks the data of a JPEG or PNG file, in a sequential JPEG file also for damage that
/// [`decode_image`](crate::decode_image) draws as a torn image.
///
/// # Errors
/// The problem, as a sentence.
pub(crate) fn check_image(bytes: &[u8]) -> Result<(), String> {
    match known_format(bytes)? {
        ImageFormat::Jpeg => check_scans(bytes).map_err(str::to_owned),
        _ => decode(bytes).map(drop),
    }
}

/// Checks the scans of a sequential JPEG file with Huffman codes. Other files pass.
///
/// # Errors
/// The problem, as a sentence.
fn check_scans(bytes: &[u8]) -> Result<(), &'static str> {
    let mut frame = Frame::default();
    let mut at = 0;
    while let Some(marker) = next_marker(bytes, at) {
        at = marker + 2;
        let kind = bytes[marker + 1];
        if matches!(kind, 0x01 | 0xd0..=0xd8) {
            continue;
        }
        if kind == 0xd9 {
            break;
        }
        let length = bytes.get(at..at + 2).map(|pair| usize::from(u16::from_be_bytes([pair[0], pair[1]])));
        let segment = length.filter(|length| *length >= 2).and_then(|length| bytes.get(at + 2..at + length));
        let segment = segment.ok_or(BAD_SEGMENT)?;
        at += segment.len() + 2;
        match kind {
            0xc4 => frame.read_tables(segment)?,
            0xc0 | 0xc1 => frame.read_size(segment)?,
            0xc2 | 0xc3 | 0xc5..=0xcf => return Ok(()), // progressive, lossless, or arithmetic codes
            0xdd => {
                let &[high, low] = segment else { return Err(BAD_SEGMENT) };
                frame.restart_interval = usize::from(u16::from_be_bytes([high, low]));
            }
            0xda => at += frame.read_scan(segment, &bytes[at..])?,
            _ => {}
        }
    }
    Ok(())
}

/// Returns the position of the next marker: 0xff, then neither 0 nor 0xff.
fn next_marker(bytes: &[u8], from: usize) -> Option<usize> {
    let rest = bytes.get(from..)?;
    rest.windows(2).position(|pair| pair[0] == 0xff && !matches!(pair[1], 0 | 0xff)).map(|at| from + at)
}

#[derive(Default)]
struct Component {
    id: u8,
    /// Blocks per unit of interleaved data.
    blocks: usize,
    /// Blocks that the image covers.
    size: usize,
}

#[derive(Default)]
struct Frame {
    components: Vec<Component>,
    units: usize,
    restart_interval: usize,
    /// Tables of direct and of alternating coefficients.
    tables: [[Option<Table>; 4]; 2],
}

/// Length and symbol of the code that starts with 16 bits; length 0 for none.
type Table = Vec<(u8, u8)>;

impl Frame {
    fn read_tables(&mut self, mut segment: &[u8]) -> Result<(), &'static str> {
        while let Some((&[kind], rest)) = segment.split_first_chunk::<1>() {
            let (counts, rest) = rest.split_first_chunk::<16>().ok_or(BAD_SEGMENT)?;
            let num_symbols = counts.iter().map(|count| usize::from(*count)).sum();
            let (symbols, rest) = rest.split_at_checked(num_symbols).ok_or(BAD_SEGMENT)?;
            let mut entries = Vec::with_capacity(1 << 16);
            let mut symbols = symbols.iter();
            for (length, count) in (1_u8..).zip(counts) {
                for symbol in symbols.by_ref().take(usize::from(*count)) {
                    entries.resize(entries.len() + (1 << (16 - length)), (length, *symbol));
                    if entries.len() > 1 << 16 {
                        return Err(BAD_SEGMENT);
                    }
                }
            }
            entries.resize(1 << 16, (0, 0));
            let table =
                self.tables.get_mut(usize::from(kind >> 4)).and_then(|tables| tables.get_mut(usize::from(kind & 15)));
            *table.ok_or(BAD_SEGMENT)? = Some(entries);
            segment = rest;
        }
        Ok(())
    }

    fn read_size(&mut self, segment: &[u8]) -> Result<(), &'static str> {
        let &[_, h1, h0, w1, w0, _, ref components @ ..] = segment else { return Err(BAD_SEGMENT) };
        let side = |high, low| usize::from(u16::from_be_bytes([high, low]));
        let [width, height] = [side(w1, w0), side(h1, h0)];
        let components = components.as_chunks::<3>().0.iter();
        // Blocks per unit, horizontally and vertically.
        let sampling = |entry: &[u8; 3]| [usize::from(entry[1] >> 4), usize::from(entry[1] & 15)];
        let is_valid = |entry: &[u8; 3]| sampling(entry).iter().all(|count| (1..=4).contains(count));
        let limit = MAX_SIDE as usize;
        if !(1..=limit).contains(&width) || !(1..=limit).contains(&height) || !components.clone().all(is_valid) {
            return Err(BAD_SEGMENT);
        }
        let most = [0, 1].map(|axis| components.clone().map(|entry| sampling(entry)[axis]).max().unwrap_or(1));
        self.units = width.div_ceil(8 * most[0]) * height.div_ceil(8 * most[1]);
        let component = |entry: &[u8; 3]| {
            let [h, v] = sampling(entry);
            let size = (width * h).div_ceil(most[0]).div_ceil(8) * (height * v).div_ceil(most[1]).div_ceil(8);
            Component { id: entry[0], blocks: h * v, size }
        };
        self.components = components.map(component).collect();
        Ok(())
    }

    /// Follows the codes of a scan; returns the number of its bytes.
    fn read_scan(&self, header: &[u8], data: &[u8]) -> Result<usize, &'static str> {
        let (&count, rest) = header.split_first().ok_or(BAD_SEGMENT)?;
        let (entries, _) = rest.split_at_checked(2 * usize::from(count)).ok_or(BAD_SEGMENT)?;
        // Components with their two tables.
        let mut scanned = Vec::new();
        for &[id, tables] in entries.as_chunks().0 {
            let component = self.components.iter().find(|component| component.id == id).ok_or(BAD_SEGMENT)?;
            let table = |kind: usize, number: u8| self.tables[kind].get(usize::from(number)).and_then(Option::as_ref);
            scanned.push((component, [table(0, tables >> 4), table(1, tables & 15)]));
        }
        let num_units = match scanned[..] {
            [] => return Err(BAD_SEGMENT),
            [(alone, _)] => alone.size,
            _ => self.units,
        };
        let (parts, num_bytes) = split_scan(data).ok_or(ENDS_EARLY)?;
        let interval = if self.restart_interval == 0 { num_units } else { self.restart_interval };
        if parts.len() != num_units.div_ceil(interval) {
            return Err(if parts.len() * interval < num_units { ENDS_EARLY } else { LEFT_OVER });
        }
        for (part, bytes) in parts.into_iter().enumerate() {
            let mut bits = Bits::new(bytes);
            for _ in 0..interval.min(num_units - part * interval) {
                for (component, tables) in &scanned {
                    for _ in 0..if scanned.len() > 1 { component.blocks } else { 1 } {
                        bits.skip_block(*tables)?;
                    }
                }
            }
            if (bits.end - bits.at) / 8 > MAX_LEFT_OVER {
                return Err(LEFT_OVER);
            }
        }
        Ok(num_bytes)
    }
}

/// Splits the data of a scan at its restart markers, without the zeros that follow bytes of 0xff. Returns the parts and the
/// position of the marker behind; `None` without one.
fn split_scan(data: &[u8]) -> Option<(Vec<Vec<u8>>, usize)> {
    let (mut parts, mut part, mut at) = (Vec::new(), Vec::new(), 0);
    loop {
        let run = data[at..].iter().position(|byte| *byte == 0xff)?;
        part.extend(&data[at..at + run]);
        at += run;
        match data.get(at + 1)? {
            0xff => at += 1,
            0 => {
                part.push(0xff);
                at += 2;
            }
            0xd0..=0xd7 => {
                parts.push(std::mem::take(&mut part));
                at += 2;
            }
            _ => break,
        }
    }
    if parts.is_empty() || !part.is_empty() {
        parts.push(part);
    }
    Some((parts, at))
}

/// A position in bits.
struct Bits {
    /// The data, and zeros for the code at its end.
    bytes: Vec<u8>,
    at: usize,
    end: usize,
}

impl Bits {
    fn new(mut bytes: Vec<u8>) -> Self {
        let end = 8 * bytes.len();
        bytes.extend([0; 4]);
        Self { bytes, at: 0, end }
    }

    fn skip(&mut self, count: u8) -> Result<(), &'static str> {
        self.at += usize::from(count);
        if self.at > self.end { Err(ENDS_EARLY) } else { Ok(()) }
    }

    /// Reads a symbol; returns its high and low half.
    fn symbol(&mut self, table: Option<&Table>) -> Result<(u8, u8), &'static str> {
        let next = self.bytes[self.at / 8..].first_chunk().map_or(0, |four| u32::from_be_bytes(*four));
        let (length, symbol) = table.ok_or(BAD_CODE)?[(next << (self.at % 8) >> 16) as usize];
        self.skip(length)?;
        if length == 0 { Err(BAD_CODE) } else { Ok((symbol >> 4, symbol & 15)) }
    }

    fn skip_block(&mut self, [direct, alternating]: [Option<&Table>; 2]) -> Result<(), &'static str> {
        let (_, size) = self.symbol(direct)?;
        self.skip(size)?;
        let mut k = 1;
        while k < 64 {
            let (run, size) = self.symbol(alternating)?;
            if size == 0 && run < 15 {
                break; // only zeros follow
            }
            self.skip(size)?;
            k += run + 1;
            if size > 0 && k > 64 {
                return Err(BAD_CODE);
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::codec::encode_jpeg;
    use crate::testing::{fixture, ramp};

    #[test]
    fn damage_is_found_in_sequential_files() {
        for (name, jpeg) in [
            ("one scan", encode_jpeg(&ramp(101, 67), 90).unwrap()),
            ("restarts", std::fs::read(fixture("reference/restarts.jpg")).unwrap()),
        ] {
            assert_eq!(check_scans(&jpeg), Ok(()), "{name}");
            let scan = jpeg.windows(2).position(|pair| pair == [0xff, 0xda]).unwrap() + 16;
            let (mut num_found, mut num_tried) = (0, 0);
            for at in (scan..jpeg.len() - 300).step_by(97) {
                for value in [0, 0x5a] {
                    let mut damaged = jpeg.clone();
                    damaged[at..at + 200].fill(value);
                    num_found += usize::from(check_scans(&damaged).is_err());
                    num_tried += 1;
                }
            }
            assert!(num_tried > 10 && num_found * 10 >= num_tried * 9, "{name}: {num_found} of {num_tried}");
        }
    }

    #[test]
    fn malformed_files_are_errors_or_pass() {
        let jpeg = std::fs::read(fixture("reference/restarts.jpg")).unwrap();
        for at in 0..jpeg.len() {
            let _ = check_scans(&jpeg[..at]);
            for value in [0, 0xff, jpeg[at] ^ 0x10] {
                let mut changed = jpeg.clone();
                changed[at] = value;
                let _ = check_scans(&changed);
            }
        }
        assert_eq!(check_scans(b"\xff\xd8\xff\xc4\0\x01"), Err(BAD_SEGMENT));
        assert_eq!(check_scans(b"\xff\xd8\xff\xda\0\x08\x01\x07\0\0\x3f\0"), Err(BAD_SEGMENT), "no such component");
    }
}
