//! A look over a binary layer before the library reads it: that believes every count and offset, so that a few forged bytes would
//! take all memory, or time without end. Checked are counts, against what the file can hold, and that names and values nest within
//! bounds. What is merely wrong is left to the library.
//!
//! ```text
//! [PXR-USDC, version, where the sections are][values ...][sections: TOKENS STRINGS FIELDS FIELDSETS PATHS SPECS]
//! ```

use crate::limits;

/// Bytes that a file of any size may expand to, and how much more its own size may: constant arrays compress by far.
const EXPANDED_MIN: u64 = 256 << 20;
const EXPANSION: u64 = 300;
/// Most values that are looked at, shared ones each time.
const VALUES_MAX: usize = 1 << 24;
/// Arrays of fewer elements are never compressed.
const PACKED_MIN: u64 = 4;
/// Least bytes of a reference, of a payload and of an entry of a dictionary.
const REFERENCE_BYTES: u64 = 32;
const PAYLOAD_BYTES: u64 = 8;
const ENTRY_BYTES: u64 = 20;

/// What is wrong with a layer, if anything is.
pub(super) fn check(bytes: &[u8]) -> Result<(), String> {
    let mut head = At { bytes, at: 8 };
    let version = head.slice(8)?;
    let version = [version[0], version[1], version[2]];
    if version < [0, 4, 0] {
        let [major, minor, patch] = version;
        return Err(format!(
            "version {major}.{minor}.{patch} is too old: save it anew with usdcat"
        ));
    }
    let file = Crate {
        bytes,
        version,
        expanded_max: EXPANDED_MIN.max(bytes.len() as u64 * EXPANSION),
    };
    let mut sections = file.at(head.number()?)?;
    let count = sections.count(32)?;
    let mut lengths = Vec::new();
    for _ in 0..count {
        let entry = sections.slice(32)?;
        let word = |at: usize| u64::from_le_bytes(std::array::from_fn(|byte| entry[at + byte]));
        let mut section = file.at(word(16))?;
        // TOKENS come first: names of PATHS are numbers of theirs.
        match entry.split(|byte| *byte == 0).next().unwrap_or_default() {
            b"TOKENS" => lengths = file.tokens(&mut section)?,
            b"STRINGS" => section.count(4).map(drop)?,
            b"FIELDS" => file.fields(&mut section)?,
            b"FIELDSETS" => file.integers(&mut section, None).map(drop)?,
            b"PATHS" => file.paths(&mut section, &lengths)?,
            b"SPECS" => {
                let count = section.number()?;
                (0..3).try_for_each(|_| file.integers(&mut section, Some(count)).map(drop))?;
            }
            _ => {}
        }
    }
    Ok(())
}

/// A place in the file.
#[derive(Clone, Copy)]
struct At<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl<'a> At<'a> {
    fn left(&self) -> u64 {
        (self.bytes.len() - self.at) as u64
    }

    fn slice(&mut self, length: u64) -> Result<&'a [u8], String> {
        if length > self.left() {
            return Err(format!(
                "{length} bytes are announced at byte {}, {} are left",
                self.at,
                self.left()
            ));
        }
        let start = self.at;
        self.at += length as usize;
        Ok(&self.bytes[start..self.at])
    }

    fn number(&mut self) -> Result<u64, String> {
        let bytes = self.slice(8)?;
        Ok(u64::from_le_bytes(std::array::from_fn(|at| bytes[at])))
    }

    /// A number of things of at least so many bytes each, which follow.
    fn count(&mut self, bytes: u64) -> Result<u64, String> {
        let (at, count) = (self.at, self.number()?);
        match count.checked_mul(bytes) {
            Some(needed) if needed <= self.left() => Ok(count),
            _ => Err(format!(
                "{count} things are announced at byte {at}, {} bytes are left",
                self.left()
            )),
        }
    }

    /// Goes past things of so many bytes each, whose number is before them.
    fn things(&mut self, bytes: u64) -> Result<(), String> {
        let count = self.count(bytes)?;
        self.slice(count * bytes).map(drop)
    }

    /// The place that a relative offset points to.
    fn pointed(&mut self) -> Result<Self, String> {
        let (start, offset) = (self.at as i64, self.number()? as i64);
        let at = start
            .checked_add(offset)
            .filter(|at| (0..=self.bytes.len() as i64).contains(at));
        let at = at.ok_or_else(|| format!("the offset at byte {start} leaves the file"))?;
        Ok(Self {
            bytes: self.bytes,
            at: at as usize,
        })
    }
}

struct Crate<'a> {
    bytes: &'a [u8],
    version: [u8; 3],
    expanded_max: u64,
}

impl<'a> Crate<'a> {
    fn at(&self, place: u64) -> Result<At<'a>, String> {
        match usize::try_from(place) {
            Ok(at) if at <= self.bytes.len() => Ok(At { bytes: self.bytes, at }),
            _ => Err(format!(
                "the offset {place} is beyond the file's {} bytes",
                self.bytes.len()
            )),
        }
    }

    /// Whether so many things of so many bytes each may come out of less.
    fn expands(&self, count: u64, bytes: u64) -> Result<usize, String> {
        match count.checked_mul(bytes) {
            Some(needed) if needed <= self.expanded_max => Ok(needed as usize),
            _ => Err(format!(
                "{count} things of {bytes} bytes are announced, the file has {}",
                self.bytes.len()
            )),
        }
    }

    /// A compressed block of at most so many bytes.
    fn unpacked(&self, place: &mut At<'a>, most: usize) -> Result<Vec<u8>, String> {
        let length = place.number()?;
        let packed = place.slice(length)?;
        let mut unpacked = vec![0; most];
        let length = match packed.split_first() {
            Some((0, packed)) => {
                lz4_flex::block::decompress_into(packed, &mut unpacked).map_err(|error| error.to_string())?
            }
            _ => {
                return Err(format!(
                    "the block at byte {} is in pieces: save the layer anew with usdcat",
                    place.at
                ));
            }
        };
        unpacked.truncate(length);
        Ok(unpacked)
    }

    /// Whole numbers, with their number before them if it is not known.
    fn integers(&self, place: &mut At<'a>, count: Option<u64>) -> Result<Vec<i32>, String> {
        let count = count.map_or_else(|| place.number(), Ok)?;
        // Two bits and at most four bytes each, after the commonest.
        self.expands(count, 5)?;
        let count = count as usize;
        let codes_end = 4 + (2 * count).div_ceil(8);
        let unpacked = self.unpacked(place, codes_end + 4 * count)?;
        let short = || "a block of numbers is too short".to_owned();
        let number = |at: usize, bytes: usize| {
            let found = unpacked.get(at..at + bytes).ok_or_else(short)?;
            let sign = if found.last().is_some_and(|byte| *byte > 127) {
                u8::MAX
            } else {
                0
            };
            Ok::<_, String>(i32::from_le_bytes(std::array::from_fn(|at| {
                found.get(at).copied().unwrap_or(sign)
            })))
        };
        if count == 0 {
            return Ok(Vec::new());
        }
        let (common, mut at, mut last) = (number(0, 4)?, codes_end, 0i32);
        let mut numbers = Vec::with_capacity(count);
        for index in 0..count {
            let code = unpacked.get(4 + index / 4).ok_or_else(short)? >> (2 * (index % 4)) & 3;
            let bytes = [0, 1, 2, 4][usize::from(code)];
            last = last.wrapping_add(if bytes == 0 { common } else { number(at, bytes)? });
            at += bytes;
            numbers.push(last);
        }
        Ok(numbers)
    }

    /// The lengths of all tokens.
    fn tokens(&self, place: &mut At<'a>) -> Result<Vec<u64>, String> {
        let (count, bytes) = (place.number()?, place.number()?);
        self.expands(count, 1)?;
        let unpacked = self.unpacked(place, self.expands(bytes, 1)?)?;
        Ok(unpacked
            .split(|byte| *byte == 0)
            .map(|token| token.len() as u64)
            .collect())
    }

    /// Paths are a tree whose every node is visited once, none of it deep, all of it within bounds when written out.
    fn paths(&self, place: &mut At<'a>, lengths: &[u64]) -> Result<(), String> {
        let all = place.number()?;
        self.expands(all, 32)?;
        let count = place.number()?;
        let _places = self.integers(place, Some(count))?;
        let names = self.integers(place, Some(count))?;
        let jumps = self.integers(place, Some(count))?;
        let (mut visits, mut bytes) = (0, 0);
        let mut pending = if jumps.is_empty() { Vec::new() } else { vec![(0, 0, 0)] };
        while let Some((mut node, mut depth, mut above)) = pending.pop() {
            loop {
                visits += 1;
                let (Some(&jump), Some(name)) = (jumps.get(node), names.get(node)) else {
                    return Err("the tree of paths leaves the file".to_owned());
                };
                let length = above + 1 + lengths.get(name.unsigned_abs() as usize).copied().unwrap_or(0);
                bytes += length;
                if visits > jumps.len() || depth > limits::USD_DEPTH_MAX || bytes > self.expanded_max {
                    return Err(format!(
                        "the tree of {} paths is too deep or goes in circles",
                        jumps.len()
                    ));
                }
                let (child, sibling) = (jump > 0 || jump == -1, jump >= 0);
                if child {
                    if sibling {
                        pending.push((node + jump as usize, depth, above));
                    }
                    (depth, above) = (depth + 1, length);
                }
                if !child && !sibling {
                    break;
                }
                node += 1;
            }
        }
        Ok(())
    }

    fn fields(&self, place: &mut At<'a>) -> Result<(), String> {
        let count = place.number()?;
        self.integers(place, Some(count))?;
        let values = self.unpacked(place, self.expands(count, 8)?)?;
        let mut left = VALUES_MAX;
        let mut values = values.as_chunks::<8>().0.iter().map(|bytes| u64::from_le_bytes(*bytes));
        values.try_for_each(|value| self.value(value, 0, &mut left))
    }

    /// A value, and those in it.
    fn value(&self, value: u64, depth: usize, left: &mut usize) -> Result<(), String> {
        let (array, inlined, compressed) = (value >> 63 & 1 == 1, value >> 62 & 1 == 1, value >> 61 & 1 == 1);
        let (kind, payload) = (value >> 48 & 0xff, value & 0xffff_ffff_ffff);
        *left = left.saturating_sub(1);
        if *left == 0 || depth > limits::USD_DEPTH_MAX {
            return Err(format!("values at byte {payload} are nested too deeply or too often"));
        }
        if inlined {
            return Ok(());
        }
        let mut place = self.at(payload)?;
        match kind {
            // Texts, names of files and expressions.
            10 | 12 | 57 if array => place.count(4).map(drop),
            _ if array || kind == 48 => self.array(kind, compressed, payload),
            31 => self.dictionary(&mut place, depth, left),
            // Lists of changes: of numbers of names, of whole numbers, of references, of payloads.
            32 | 33 | 34 | 36 | 38 | 54 => each_list(place, |place| place.things(4)),
            37 | 39 => each_list(place, |place| place.things(8)),
            35 => each_list(place, |place| {
                let count = place.count(REFERENCE_BYTES)?;
                (0..count).try_for_each(|_| {
                    place.slice(24)?;
                    self.dictionary(place, depth, left)
                })
            }),
            55 => each_list(place, |place| {
                let count = place.count(PAYLOAD_BYTES)?;
                let bytes = if self.version >= [0, 8, 0] { 24 } else { 8 };
                (0..count).try_for_each(|_| place.slice(bytes).map(drop))
            }),
            40 | 41 | 50 => place.count(4).map(drop),
            45 | 58 => place.count(8).map(drop),
            46 => self.samples(&mut place, depth, left),
            49 => place.count(16).map(drop),
            _ => Ok(()),
        }
    }

    fn array(&self, kind: u64, compressed: bool, payload: u64) -> Result<(), String> {
        if payload == 0 {
            return Ok(());
        }
        let mut place = self.at(payload)?;
        if self.version < [0, 5, 0] {
            place.slice(4)?;
        }
        let count = match self.version < [0, 7, 0] {
            true => place
                .slice(4)?
                .iter()
                .rev()
                .fold(0, |count, byte| count << 8 | u64::from(*byte)),
            false => place.number()?,
        };
        let (whole, floating) = (matches!(kind, 3..=6), matches!(kind, 7..=9 | 48 | 56));
        let packed = compressed && count >= PACKED_MIN;
        if packed && (whole && self.version >= [0, 5, 0] || floating && self.version >= [0, 6, 0]) {
            // Numbers that become as many of eight bytes at most; floats perhaps by way of a table.
            self.expands(count, 8)?;
            if floating && place.slice(1)? == b"t" {
                let entries = place
                    .slice(4)?
                    .iter()
                    .rev()
                    .fold(0, |count, byte| count << 8 | u64::from(*byte));
                place.slice(entries * element_bytes(kind))?;
            }
            return place.count(1).map(drop);
        }
        match count.checked_mul(element_bytes(kind)) {
            Some(needed) if needed <= place.left() => Ok(()),
            _ => Err(format!(
                "an array of {count} elements is announced at byte {payload}, {} bytes are left",
                place.left()
            )),
        }
    }

    fn samples(&self, place: &mut At<'a>, depth: usize, left: &mut usize) -> Result<(), String> {
        let mut times = place.pointed()?;
        self.value(times.number()?, depth + 1, left)?;
        let mut values = times.pointed()?;
        let count = values.count(8)?;
        (0..count).try_for_each(|_| self.value(values.number()?, depth + 1, left))
    }

    fn dictionary(&self, place: &mut At<'a>, depth: usize, left: &mut usize) -> Result<(), String> {
        let count = place.count(ENTRY_BYTES)?;
        for _ in 0..count {
            place.slice(4)?;
            *place = place.pointed()?;
            self.value(place.number()?, depth + 1, left)?;
        }
        Ok(())
    }
}

/// Bytes of an element of an array of this type.
fn element_bytes(kind: u64) -> u64 {
    /// From the first type on: flags and numbers, names, matrices, quaternions, vectors of two, three and four.
    const BYTES: [u64; 30] = [
        1, 1, 4, 4, 8, 8, 2, 4, 8, 4, 4, 4, 32, 72, 128, 32, 16, 8, 16, 8, 4, 8, 24, 12, 6, 12, 32, 16, 8, 16,
    ];
    let known = usize::try_from(kind)
        .ok()
        .and_then(|kind| BYTES.get(kind.wrapping_sub(1)));
    known.copied().unwrap_or(8)
}

/// The up to six lists that a value of changes has.
fn each_list<'a>(mut place: At<'a>, mut list: impl FnMut(&mut At<'a>) -> Result<(), String>) -> Result<(), String> {
    let lists = place.slice(1)?[0] >> 1 & 0b11_1111;
    (0..lists.count_ones()).try_for_each(|_| list(&mut place))
}
