//! Buffers of an output node, filled by us and shown by the driver.
//!
//! The crate's own stream waits for a buffer that is done before it hands the first one in, which never comes, and shows a picture only when
//! the next is there. So the buffers are held here: taken back as the driver is done with them, filled, and handed in at once.

use std::io;
use std::sync::Arc;
use std::time::Duration;

use v4l::buffer::Type;
use v4l::device::{Device, Handle};
use v4l::memory::Memory;
use v4l::v4l_sys::{v4l2_buffer, v4l2_requestbuffers};
use v4l::v4l2;
use v4l::v4l2::vidioc::{VIDIOC_DQBUF, VIDIOC_QBUF, VIDIOC_QUERYBUF, VIDIOC_REQBUFS};

use crate::video4linux::ioctl::{Argument as _, call};

/// Poll's event: a buffer is done.
const WRITABLE: i16 = 4;
/// `PROT_READ | PROT_WRITE` and `MAP_SHARED`.
const READ_AND_WRITE: i32 = 3;
const SHARED: i32 = 1;

/// The driver's buffers.
pub struct OutputBuffers {
    handle: Arc<Handle>,
    buffers: Vec<&'static mut [u8]>,
    free: Vec<usize>,
    streaming: Streaming,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Streaming {
    NotYet,
    Begun,
}

impl std::fmt::Debug for OutputBuffers {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("OutputBuffers")
            .field("buffers", &self.buffers.len())
            .field("free", &self.free)
            .finish_non_exhaustive()
    }
}

fn asked(index: u32) -> v4l2_buffer {
    let mut buffer = v4l2_buffer::zeroed();
    buffer.type_ = Type::VideoOutput as u32;
    buffer.memory = Memory::Mmap as u32;
    buffer.index = index;
    buffer
}

impl OutputBuffers {
    /// Ask the driver for `count` buffers of the format that is set.
    pub fn new(device: &Device, count: u32) -> io::Result<Self> {
        let handle = device.handle();
        let mut wanted = v4l2_requestbuffers::zeroed();
        wanted.count = count;
        wanted.type_ = Type::VideoOutput as u32;
        wanted.memory = Memory::Mmap as u32;
        call(&handle, VIDIOC_REQBUFS, &mut wanted)?;
        let mut mapped = Self {
            handle,
            buffers: Vec::new(),
            free: Vec::new(),
            streaming: Streaming::NotYet,
        };
        for index in 0..wanted.count {
            let mut buffer = asked(index);
            call(&mapped.handle, VIDIOC_QUERYBUF, &mut buffer)?;
            let length = buffer.length as usize;
            #[expect(unsafe_code, reason = "the crate keeps the buffers of its own stream to itself")]
            // SAFETY: the driver told offset and length of this mapping of its memory. It stays until our drop takes it away, after
            // the last use of the slice, and no other slice is made of it. The kernel does not write to an output's buffers.
            let bytes = unsafe {
                let start = v4l2::mmap(
                    std::ptr::null_mut(),
                    length,
                    READ_AND_WRITE,
                    SHARED,
                    mapped.handle.fd(),
                    buffer.m.offset.into(),
                )?;
                std::slice::from_raw_parts_mut(start.cast::<u8>(), length)
            };
            mapped.free.push(mapped.buffers.len());
            mapped.buffers.push(bytes);
        }
        if mapped.buffers.is_empty() {
            return Err(io::Error::other("the driver gave no buffer"));
        }
        Ok(mapped)
    }

    /// Take back what the driver is done with.
    fn take_back(&mut self) -> io::Result<()> {
        while self.free.len() < self.buffers.len() {
            let mut done = asked(0);
            match call(&self.handle, VIDIOC_DQBUF, &mut done) {
                Ok(()) => self.free.push(done.index as usize),
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => break,
                Err(error) => return Err(error),
            }
        }
        Ok(())
    }

    /// Fill a buffer and hand it in; false when none was free in time.
    pub fn show(&mut self, patience: Duration, fill: impl FnOnce(&mut [u8])) -> io::Result<bool> {
        if self.streaming == Streaming::Begun {
            self.take_back()?;
            if self.free.is_empty() {
                let milliseconds = i32::try_from(patience.as_millis()).unwrap_or(i32::MAX);
                self.handle.poll(WRITABLE, milliseconds)?;
                self.take_back()?;
            }
        }
        let Some(index) = self.free.pop() else { return Ok(false) };
        let Some(bytes) = self.buffers.get_mut(index) else {
            return Ok(false);
        };
        fill(bytes);
        let mut filled = asked(index as u32);
        filled.bytesused = bytes.len() as u32;
        // V4L2_FIELD_NONE: whole pictures.
        filled.field = 1;
        if let Err(error) = call(&self.handle, VIDIOC_QBUF, &mut filled) {
            self.free.push(index);
            return Err(error);
        }
        if self.streaming == Streaming::NotYet {
            self.switch(v4l2::vidioc::VIDIOC_STREAMON)?;
            self.streaming = Streaming::Begun;
        }
        Ok(true)
    }

    fn switch(&self, request: v4l2::vidioc::_IOC_TYPE) -> io::Result<()> {
        let mut kind = Type::VideoOutput as i32;
        call(&self.handle, request, &mut kind)
    }
}

impl Drop for OutputBuffers {
    fn drop(&mut self) {
        // A device that is gone has stopped already.
        let _stopped = self.switch(v4l2::vidioc::VIDIOC_STREAMOFF);
        for bytes in self.buffers.drain(..) {
            let (start, length) = (bytes.as_mut_ptr(), bytes.len());
            #[expect(unsafe_code, reason = "what was mapped is given back")]
            // SAFETY: mapped by `new` with this length; the slice was the only way to it and is not used again.
            let _given_back = unsafe { v4l2::munmap(start.cast(), length) };
        }
        // So that whoever opens the node next may set another format.
        let mut none = v4l2_requestbuffers::zeroed();
        none.type_ = Type::VideoOutput as u32;
        none.memory = Memory::Mmap as u32;
        let _freed = call(&self.handle, VIDIOC_REQBUFS, &mut none);
    }
}
