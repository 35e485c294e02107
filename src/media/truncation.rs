//! Whether a file holds fewer bytes than its own headers promise.
//!
//! libav reports the end of a cut-off file as the end of the video. MP4/MOV are a list of boxes, AVI a list of RIFF chunks,
//! Matroska one segment; each begins with its length (ISO/IEC 14496-12 §4.2, RFC 8794), so the promise is easily checked.

use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;

/// How a file falls short.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Shortfall {
    /// So many bytes are missing at the end.
    Bytes(u64),
    /// An MP4 or MOV without its index (`moov`): the recorder was stopped before it wrote one, or the end is missing.
    Index,
}

/// How the file falls short of what its headers promise; `None` when it is whole, of another kind or unreadable.
pub fn shortfall(path: &Path) -> Option<Shortfall> {
    let mut file = File::open(path).ok()?;
    let length = file.metadata().ok()?.len();
    let mut head = [0; 12];
    file.read_exact(&mut head).ok()?;
    match &head {
        [_, _, _, _, b'f', b't', b'y', b'p', ..] | [_, _, _, _, b'm', b'd', b'a', b't', ..] => boxes(&mut file, length),
        [b'R', b'I', b'F', b'F', ..] => riff(&mut file, length),
        [0x1A, 0x45, 0xDF, 0xA3, ..] => matroska(&mut file, length),
        _ => None,
    }
}

fn missing(promised: u64, length: u64) -> Option<Shortfall> {
    (promised > length).then(|| Shortfall::Bytes(promised - length))
}

fn boxes(file: &mut File, length: u64) -> Option<Shortfall> {
    let (mut at, mut indexed, mut cut) = (0_u64, false, None);
    while at + 8 <= length {
        file.seek(SeekFrom::Start(at)).ok()?;
        let mut head = [0; 8];
        file.read_exact(&mut head).ok()?;
        let [a, b, c, d, kind @ ..] = head;
        let mut size = u64::from(u32::from_be_bytes([a, b, c, d]));
        if size == 1 {
            let mut long = [0; 8];
            file.read_exact(&mut long).ok()?;
            size = u64::from_be_bytes(long);
        } else if size == 0 {
            size = length - at;
        }
        if size < 8 {
            return None;
        }
        let end = at.checked_add(size)?;
        indexed |= &kind == b"moov" && end <= length;
        cut = cut.or(missing(end, length));
        at = end;
    }
    if indexed { cut } else { Some(Shortfall::Index) }
}

fn riff(file: &mut File, length: u64) -> Option<Shortfall> {
    let mut at = 0_u64;
    while at + 8 <= length {
        file.seek(SeekFrom::Start(at)).ok()?;
        let mut head = [0; 8];
        file.read_exact(&mut head).ok()?;
        let [b'R', b'I', b'F', b'F', size @ ..] = head else {
            return None;
        };
        let size = u64::from(u32::from_le_bytes(size));
        // A recorder that was killed leaves the length at 0 or at its largest value: no promise.
        if size == 0 || size >= u64::from(u32::MAX) - 8 {
            return None;
        }
        let end = at + 8 + size;
        if end > length {
            return missing(end, length);
        }
        at = end + size % 2;
    }
    None
}

fn matroska(file: &mut File, length: u64) -> Option<Shortfall> {
    file.seek(SeekFrom::Start(4)).ok()?;
    let header = variable_length(file)??;
    let at = file.stream_position().ok()?;
    file.seek(SeekFrom::Start(at + header)).ok()?;
    let mut id = [0; 4];
    file.read_exact(&mut id).ok()?;
    if id != [0x18, 0x53, 0x80, 0x67] {
        return None;
    }
    let size = variable_length(file)??;
    missing(file.stream_position().ok()?.checked_add(size)?, length)
}

/// An EBML length: leading zeros count the bytes; all ones mean "unknown" (`Some(None)`).
fn variable_length(file: &mut File) -> Option<Option<u64>> {
    let mut first = [0];
    file.read_exact(&mut first).ok()?;
    let [first] = first;
    let more = first.leading_zeros();
    if more > 7 {
        return None;
    }
    let mut value = u64::from(first) & ((1_u64 << (7 - more)) - 1);
    for _ in 0..more {
        let mut byte = [0];
        file.read_exact(&mut byte).ok()?;
        let [byte] = byte;
        value = value << 8 | u64::from(byte);
    }
    let unknown = (1_u64 << (7 * (more + 1))) - 1;
    Some((value != unknown).then_some(value))
}
