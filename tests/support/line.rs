//! Sources, stages and sinks that do exactly what a test tells them.

use std::sync::{Arc, Mutex};

use crossbeam::channel::{Receiver, Sender};
use endofield::frame::{Frame, FrameId};
use endofield::image::buffer::Rgb8;
use endofield::image::pool::Pool;
use endofield::pipeline::stage::{Sink, SinkError, Source, SourceError, Stage, StageError};
use endofield::time::Timestamp;

use crate::support::scene;

/// A gray frame whose level is its number.
pub fn numbered_frame(number: u64, pool: &Pool<Rgb8>) -> Frame {
    let mut image = pool.take(8, 4);
    image.fill([number as u8; 3]);
    let exposed_at = Timestamp(number as i64 * 40_000_000);
    Frame::new(FrameId(number), exposed_at, Timestamp(0), image)
}

/// So many numbered frames, then the end, or an error.
pub struct Numbered {
    next: u64,
    count: u64,
    pool: Pool<Rgb8>,
    error: Option<&'static str>,
    /// Waits for a permission before each frame, if given.
    permission: Option<Receiver<()>>,
}

impl Numbered {
    pub fn new(count: u64) -> Self {
        Self {
            next: 0,
            count,
            pool: Pool::new(16),
            error: None,
            permission: None,
        }
    }

    pub fn then_error(mut self, message: &'static str) -> Self {
        self.error = Some(message);
        self
    }

    pub fn on_permission(mut self, permission: Receiver<()>) -> Self {
        self.permission = Some(permission);
        self
    }
}

impl Source for Numbered {
    fn next_frame(&mut self) -> Result<Option<Frame>, SourceError> {
        if let Some(permission) = &self.permission
            && permission.recv().is_err()
        {
            return Ok(None);
        }
        if self.next == self.count {
            return self.error.map_or(Ok(None), |message| Err(SourceError(message.to_owned())));
        }
        self.next += 1;
        Ok(Some(numbered_frame(self.next - 1, &self.pool)))
    }
}

/// A stage made of a closure; counts its resets.
pub struct Doing<F> {
    pub name: &'static str,
    pub work: F,
    pub resets: Arc<Mutex<Vec<&'static str>>>,
}

impl<F: FnMut(&mut Frame) -> Result<(), StageError> + Send> Doing<F> {
    pub fn boxed(name: &'static str, work: F) -> Box<Self> {
        Box::new(Self {
            name,
            work,
            resets: Arc::default(),
        })
    }
}

impl<F: FnMut(&mut Frame) -> Result<(), StageError> + Send> Stage for Doing<F> {
    fn name(&self) -> &'static str {
        self.name
    }

    fn process(&mut self, frame: &mut Frame) -> Result<(), StageError> {
        (self.work)(frame)
    }

    fn reset(&mut self) {
        self.resets.lock().unwrap().push(self.name);
    }
}

/// Adds to every level, as a well-behaved stage: on its own buffer, swapped in at the end.
pub fn adding(name: &'static str, levels: u8) -> Box<dyn Stage> {
    let mut own = endofield::image::buffer::Image::filled(0, 0, [0; 3]);
    Doing::boxed(name, move |frame: &mut Frame| {
        own.copy_from(&frame.image);
        own.pixels_mut()
            .iter_mut()
            .for_each(|pixel| *pixel = pixel.map(|level| level.wrapping_add(levels)));
        frame.image.swap(&mut own);
        Ok(())
    })
}

/// A frame's number and its picture's bytes.
#[derive(PartialEq)]
pub struct SeenFrame {
    pub id: u64,
    pub bytes: Vec<u8>,
}

/// What a sink has seen.
#[derive(Clone, Default)]
pub struct Seen {
    pub frames: Arc<Mutex<Vec<SeenFrame>>>,
    pub finished: Arc<Mutex<u32>>,
}

impl Seen {
    pub fn ids(&self) -> Vec<u64> {
        self.frames.lock().unwrap().iter().map(|frame| frame.id).collect()
    }

    /// The level of each frame's first pixel.
    pub fn levels(&self) -> Vec<u8> {
        self.frames.lock().unwrap().iter().map(|frame| frame.bytes[0]).collect()
    }

    pub fn finished(&self) -> u32 {
        *self.finished.lock().unwrap()
    }
}

/// Keeps what it is given.
pub struct Keeping {
    name: &'static str,
    seen: Seen,
    /// Fails at this frame.
    fail_at: Option<u64>,
    /// Tells that it has begun on a frame, then waits to be let on.
    gate: Option<(Sender<u64>, Receiver<()>)>,
}

impl Keeping {
    pub fn new(name: &'static str) -> (Self, Seen) {
        let seen = Seen::default();
        (
            Self {
                name,
                seen: seen.clone(),
                fail_at: None,
                gate: None,
            },
            seen,
        )
    }

    pub fn failing_at(mut self, frame: u64) -> Self {
        self.fail_at = Some(frame);
        self
    }

    pub fn gated(mut self, begun: Sender<u64>, go: Receiver<()>) -> Self {
        self.gate = Some((begun, go));
        self
    }
}

impl Sink for Keeping {
    fn name(&self) -> &'static str {
        self.name
    }

    fn consume(&mut self, frame: &Arc<Frame>) -> Result<(), SinkError> {
        if let Some((begun, go)) = &self.gate {
            let _test_ended = begun.send(frame.id.0);
            let _test_ended = go.recv();
        }
        if self.fail_at == Some(frame.id.0) {
            return Err(SinkError("the disk is full".to_owned()));
        }
        self.seen.frames.lock().unwrap().push(SeenFrame {
            id: frame.id.0,
            bytes: frame.image.as_bytes().to_vec(),
        });
        Ok(())
    }

    fn finish(&mut self) -> Result<(), SinkError> {
        *self.seen.finished.lock().unwrap() += 1;
        Ok(())
    }
}

/// So many frames of the stand-in for an operation.
pub struct Wandering {
    size: (usize, usize),
    next: u64,
    count: u64,
    pool: Pool<Rgb8>,
}

impl Wandering {
    pub fn new(width: usize, height: usize, count: u64) -> Self {
        Self {
            size: (width, height),
            next: 0,
            count,
            pool: Pool::new(16),
        }
    }
}

impl Source for Wandering {
    fn next_frame(&mut self) -> Result<Option<Frame>, SourceError> {
        if self.next == self.count {
            return Ok(None);
        }
        self.next += 1;
        let image = scene::picture(self.size.0, self.size.1, self.next - 1);
        Ok(Some(scene::frame(self.next - 1, &image, &self.pool)))
    }
}
