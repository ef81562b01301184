//! Damage in the middle of a JPEG file. Decoders draw a torn image and report nothing; here the Huffman codes of every scan
//! are followed without computing pixels, and must end with the data of the scan.

use image::ImageFormat;

use crate::image::codec::{MAX_SIDE, decode, known_format};

/// Bytes between the last block of a scan and the next marker that are accepted as padding of the writer.
const MAX_LEFT_OVER: usize = 16;
const MAX_SCANS: usize = 128;

const ENDS_EARLY: &str = "the image data ends before its last block";
const LEFT_OVER: &str = "image data is left over after its last block";
const BAD_CODE: &str = "the image data has an invalid code";
const BAD_SEGMENT: &str = "a segment of the header is malformed";

/// Checks the data of a JPEG or PNG file, in a JPEG file also for damage that [`decode_image`](crate::decode_image) draws as a
/// torn image.
///
/// # Errors
/// The problem, as a sentence.
pub(crate) fn check_image(bytes: &[u8]) -> Result<(), String> {
    match known_format(bytes)? {
        ImageFormat::Jpeg => check_scans(bytes).map_err(str::to_owned),
        _ => decode(bytes).map(drop),
    }
}

/// Checks the scans of a JPEG file with Huffman codes, sequential or progressive. Other files pass.
///
/// # Errors
/// The problem, as a sentence.
fn check_scans(bytes: &[u8]) -> Result<(), &'static str> {
    let mut frame = Frame::default();
    let (mut at, mut num_scans) = (0, 0);
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
            0xc0..=0xc2 => frame.read_size(segment, kind == 0xc2)?,
            0xc3 | 0xc5..=0xcf => return Ok(()), // lossless, or arithmetic codes
            0xdd => {
                let &[high, low] = segment else { return Err(BAD_SEGMENT) };
                frame.restart_interval = usize::from(u16::from_be_bytes([high, low]));
            }
            0xda => {
                num_scans += 1;
                if num_scans > MAX_SCANS {
                    return Err("the image has more than 128 scans");
                }
                at += frame.read_scan(segment, &bytes[at..])?;
            }
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
    /// Blocks per unit of interleaved data, horizontally and vertically.
    sampling: [usize; 2],
    /// Blocks per row and column that the image covers, and per row of `coded`.
    size: [usize; 2],
    stride: usize,
    /// For progressive files, a bit per coefficient of every block that is not 0.
    coded: Vec<u64>,
}

#[derive(Default)]
struct Frame {
    components: Vec<Component>,
    units: [usize; 2],
    is_progressive: bool,
    restart_interval: usize,
    /// Tables of direct and of alternating coefficients.
    tables: [[Option<Table>; 4]; 2],
}

/// Length and symbol of the code that starts with 16 bits; length 0 for none.
struct Table(Vec<(u8, u8)>);

/// Spectral range and bit positions of a scan.
#[derive(Clone, Copy)]
struct Range {
    first: u32,
    last: u32,
    refines: bool,
}

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
            *table.ok_or(BAD_SEGMENT)? = Some(Table(entries));
            segment = rest;
        }
        Ok(())
    }

    fn read_size(&mut self, segment: &[u8], is_progressive: bool) -> Result<(), &'static str> {
        let &[_, h1, h0, w1, w0, _, ref components @ ..] = segment else { return Err(BAD_SEGMENT) };
        let side = |high, low| usize::from(u16::from_be_bytes([high, low]));
        let [width, height] = [side(w1, w0), side(h1, h0)];
        let (components, _) = components.as_chunks::<3>();
        let sampling = |entry: &[u8; 3]| [usize::from(entry[1] >> 4), usize::from(entry[1] & 15)];
        let is_valid = |entry: &[u8; 3]| sampling(entry).iter().all(|count| (1..=4).contains(count));
        let limit = MAX_SIDE as usize;
        if !(1..=limit).contains(&width) || !(1..=limit).contains(&height) || !components.iter().all(is_valid) {
            return Err(BAD_SEGMENT);
        }
        let most = |axis: usize| components.iter().map(|entry| sampling(entry)[axis]).max().unwrap_or(1);
        let most = [most(0), most(1)];
        self.units = [width.div_ceil(8 * most[0]), height.div_ceil(8 * most[1])];
        self.is_progressive = is_progressive;
        self.components = components
            .iter()
            .map(|entry| {
                let [h, v] = sampling(entry);
                let size = [(width * h).div_ceil(most[0]).div_ceil(8), (height * v).div_ceil(most[1]).div_ceil(8)];
                let stride = self.units[0] * h;
                let num_coded = if is_progressive { stride * self.units[1] * v } else { 0 };
                Component { id: entry[0], sampling: [h, v], size, stride, coded: vec![0; num_coded] }
            })
            .collect();
        Ok(())
    }

    /// Follows the codes of a scan; returns the number of its bytes.
    fn read_scan(&mut self, header: &[u8], data: &[u8]) -> Result<usize, &'static str> {
        let (&count, rest) = header.split_first().ok_or(BAD_SEGMENT)?;
        let (entries, rest) = rest.split_at_checked(2 * usize::from(count)).ok_or(BAD_SEGMENT)?;
        let &[first, last, bits] = rest else { return Err(BAD_SEGMENT) };
        let range = if self.is_progressive {
            Range { first: first.into(), last: last.into(), refines: bits >> 4 != 0 }
        } else {
            Range { first: 0, last: 63, refines: false }
        };
        if range.first > range.last || range.last > 63 || (self.is_progressive && range.first == 0 && range.last != 0) {
            return Err(BAD_SEGMENT);
        }
        // Components with the numbers of their two tables.
        let mut scanned = Vec::new();
        for &[id, tables] in entries.as_chunks().0 {
            let component = self.components.iter().position(|component| component.id == id).ok_or(BAD_SEGMENT)?;
            scanned.push((component, [usize::from(tables >> 4), usize::from(tables & 15)]));
        }
        let is_interleaved = scanned.len() > 1;
        let &(alone, _) = scanned.first().ok_or(BAD_SEGMENT)?;
        let [columns, rows] = if is_interleaved { self.units } else { self.components[alone].size };
        let mut reader = Reader { data, at: 0, bits: 0, num_bits: 0, end_of_band: 0 };
        for unit in 0..columns * rows {
            if self.restart_interval > 0 && unit > 0 && unit.is_multiple_of(self.restart_interval) {
                reader.restart()?;
            }
            let [x, y] = [unit % columns, unit / columns];
            for &(index, [direct, alternating]) in &scanned {
                let table = |kind: usize, number: usize| self.tables[kind].get(number).and_then(Option::as_ref);
                let tables = [table(0, direct), table(1, alternating)];
                let Component { sampling: [h, v], stride, coded, .. } = &mut self.components[index];
                let [h, v] = if is_interleaved { [*h, *v] } else { [1, 1] };
                for block in 0..h * v {
                    let place = (y * v + block / h) * *stride + x * h + block % h;
                    reader.block(tables, range, coded.get_mut(place).unwrap_or(&mut 0))?;
                }
            }
        }
        reader.end()
    }
}

/// Bits of a scan, without the zeros that follow bytes of 0xff.
struct Reader<'a> {
    data: &'a [u8],
    at: usize,
    bits: u64,
    num_bits: u32,
    /// Number of further blocks without new coefficients in this scan.
    end_of_band: u32,
}

impl Reader<'_> {
    fn fill(&mut self) {
        while self.num_bits <= 48 {
            let byte = match self.data.get(self.at..) {
                Some([0xff, 0, ..]) => {
                    self.at += 1;
                    0xff
                }
                Some([byte, ..]) if *byte != 0xff => *byte,
                _ => return,
            };
            self.at += 1;
            self.bits = self.bits << 8 | u64::from(byte);
            self.num_bits += 8;
        }
    }

    fn take(&mut self, count: u32) -> Result<u32, &'static str> {
        if self.num_bits < count {
            self.fill();
        }
        self.num_bits = self.num_bits.checked_sub(count).ok_or(ENDS_EARLY)?;
        Ok((self.bits >> self.num_bits) as u32 & ((1 << count) - 1))
    }

    /// Reads a symbol; returns its high and low half.
    fn symbol(&mut self, table: Option<&Table>) -> Result<(u32, u32), &'static str> {
        let Table(entries) = table.ok_or(BAD_CODE)?;
        if self.num_bits < 16 {
            self.fill();
        }
        let next =
            if self.num_bits < 16 { self.bits << (16 - self.num_bits) } else { self.bits >> (self.num_bits - 16) };
        match entries[next as usize & 0xffff] {
            (0, _) => Err(if self.num_bits < 16 { ENDS_EARLY } else { BAD_CODE }),
            (length, symbol) => {
                self.take(length.into())?;
                Ok((u32::from(symbol >> 4), u32::from(symbol & 15)))
            }
        }
    }

    fn block(
        &mut self,
        [direct, table]: [Option<&Table>; 2],
        range: Range,
        coded: &mut u64,
    ) -> Result<(), &'static str> {
        let Range { first, last, refines } = range;
        let mut k = first;
        if k == 0 {
            if refines {
                self.take(1)?;
            } else {
                let (_, size) = self.symbol(direct)?;
                self.take(size)?;
            }
            k = 1;
        }
        if self.end_of_band == 0 {
            while k <= last {
                let (mut run, size) = self.symbol(table)?;
                if size == 0 && run < 15 {
                    self.end_of_band = (1 << run) + self.take(run)?;
                    break;
                }
                self.take(size)?;
                if refines {
                    // Coefficients that are not 0 have a bit of correction each and do not count for the run.
                    while k <= last && (*coded >> k & 1 == 1 || run > 0) {
                        run -= 1 - self.correct(*coded, k, k)?;
                        k += 1;
                    }
                } else {
                    k += run;
                }
                if size > 0 && k > last {
                    return Err(BAD_CODE);
                }
                *coded |= u64::from(size > 0) << (k & 63);
                k += 1;
            }
        }
        if self.end_of_band > 0 {
            self.end_of_band -= 1;
            if refines && k <= last {
                self.correct(*coded, k, last)?;
            }
        }
        Ok(())
    }

    /// Skips the bits of correction of coefficients `first..=last`; returns their number.
    fn correct(&mut self, coded: u64, first: u32, last: u32) -> Result<u32, &'static str> {
        let count = (coded >> first & (u64::MAX >> (63 - (last - first)))).count_ones();
        for left in (0..count).step_by(16) {
            self.take((count - left).min(16))?;
        }
        Ok(count)
    }

    fn restart(&mut self) -> Result<(), &'static str> {
        let at = self.end()?;
        if !matches!(self.data.get(at + 1), Some(0xd0..=0xd7)) {
            return Err(ENDS_EARLY);
        }
        (self.at, self.num_bits, self.end_of_band) = (at + 2, 0, 0);
        Ok(())
    }

    /// Returns the position of the next marker, which must follow the bits that were read.
    fn end(&mut self) -> Result<usize, &'static str> {
        let marker = next_marker(self.data, self.at).ok_or(ENDS_EARLY)?;
        let left_over = self.num_bits as usize / 8 + marker - self.at;
        if left_over > MAX_LEFT_OVER { Err(LEFT_OVER) } else { Ok(marker) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::codec::encode_jpeg;
    use crate::testing::{fixture, ramp};

    #[test]
    fn damage_is_found_in_sequential_and_progressive_files() {
        let file = |name: &str| std::fs::read(fixture(name)).unwrap();
        for (name, jpeg) in [
            ("sequential", encode_jpeg(&ramp(101, 67), 90).unwrap()),
            ("progressive", file("reference/progressive.jpg")),
            ("restarts", file("reference/restarts.jpg")),
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
        let jpeg = std::fs::read(fixture("reference/progressive.jpg")).unwrap();
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
