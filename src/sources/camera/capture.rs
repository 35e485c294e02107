//! Frames from a camera, and what to do while it gives none.
//!
//! | what happens | what the source does |
//! |---|---|
//! | the camera is not there, or is pulled out | tries again every fifth of a second, under a new name too, if the driver gave one |
//! | the stream stalls | asks whether a signal comes in; opens the stream anew once a second |
//! | a frame is marked damaged, or is short | leaves it out and counts it |
//! | frames waited too long in the driver | leaves the old ones out and counts them |
//! | the driver skipped frames | counts them; the frames' numbers show the gap |
//! | the signal's mode changed | opens the stream anew in the new mode |
//!
//! Each state is told once, when it begins, and never ends the line; only a camera that cannot be used at all does.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use crate::camera::model::CameraModel;
use crate::frame::{Frame, FrameId};
use crate::image::buffer::{Mask, Rgb8};
use crate::image::pool::Pool;
use crate::pipeline::stage::{Source, SourceError};
use crate::sources::camera::device::{Camera, CameraError, Mode, Stamp, Stream, Wish};
use crate::sources::camera::pixels::rgb_from_bytes;
use crate::time::{Clock, Span, Timestamp};

/// How long a wait for a frame may take before the wish to stop is looked at.
const WAIT: Duration = Duration::from_millis(20);
/// A camera that is not there is tried again this often.
const RETRY: Span = Span(200_000_000);
/// Without a frame for so many periods, and at least so long, a stream counts as stalled.
const STALLED_PERIODS: i64 = 6;
const STALLED: Span = Span(250_000_000);
/// A stalled stream is opened anew this often.
const REOPEN: Span = Span(1_000_000_000);
/// A frame older than this when it is taken is left out if a newer one waits.
const STALE: Span = Span(100_000_000);
/// Some drivers deliver noise when nothing comes in, and tell only who asks; asked this often.
const SIGNAL_EVERY: Span = Span(1_000_000_000);
/// So many damaged frames in a row are told of.
const MANY_DAMAGED: u64 = 25;

/// How the camera is.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum CameraState {
    /// Not asked yet.
    #[default]
    Starting,
    /// Not there; why.
    Absent(String),
    /// Open, and no frames come.
    Stalled,
    /// Open, and the driver says that nothing comes in at the other end.
    NoSignal,
    /// Frames come.
    Streaming,
}

impl CameraState {
    /// A word or two.
    pub fn word(&self) -> &'static str {
        match self {
            Self::Starting => "starting",
            Self::Absent(_) => "absent",
            Self::Stalled => "stalled",
            Self::NoSignal => "no signal",
            Self::Streaming => "streaming",
        }
    }
}

/// Counted since the source began.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct CaptureStatus {
    /// How the camera is.
    pub state: CameraState,
    /// How it delivers.
    pub mode: Option<Mode>,
    /// Frames handed on.
    pub frames: u64,
    /// Frames that the driver skipped, or that were missed while the camera was away.
    pub missed: u64,
    /// Frames marked damaged by the driver.
    pub damaged: u64,
    /// Frames with too few bytes, or bytes that are no picture.
    pub broken: u64,
    /// Frames left out because they had waited too long.
    pub stale: u64,
    /// Times the stream was opened.
    pub opened: u64,
    /// Times frames stopped coming.
    pub interruptions: u64,
}

/// Reads what a [`CaptureSource`] tells.
#[derive(Clone, Debug, Default)]
pub struct CaptureWatch(Arc<Mutex<CaptureStatus>>);

impl CaptureWatch {
    /// How it goes right now.
    pub fn status(&self) -> CaptureStatus {
        self.lock().clone()
    }

    fn lock(&self) -> MutexGuard<'_, CaptureStatus> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// A camera as a source.
pub struct CaptureSource {
    camera: Box<dyn Camera>,
    wish: Wish,
    stream: Option<Box<dyn Stream>>,
    clock: Arc<dyn Clock>,
    pool: Pool<Rgb8>,
    stop: Arc<AtomicBool>,
    watch: CaptureWatch,
    model: Option<Arc<CameraModel>>,
    field_of_view: Option<Arc<Mask>>,
    next: u64,
    last: Option<Last>,
    sequence: Option<u32>,
    opened_at: Timestamp,
    retry_at: Option<Timestamp>,
    damaged_in_a_row: u64,
    signal_asked_at: Option<Timestamp>,
}

/// The last frame that was handed on.
#[derive(Clone, Copy, Debug)]
struct Last {
    exposed_at: Timestamp,
    period: Span,
}

impl std::fmt::Debug for CaptureSource {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("CaptureSource")
            .field("camera", &self.camera.name())
            .field("status", &self.watch.status())
            .finish_non_exhaustive()
    }
}

impl CaptureSource {
    /// Frames of `camera` until `stop` is set. The camera may be absent; it is waited for.
    pub fn new(camera: Box<dyn Camera>, wish: Wish, clock: Arc<dyn Clock>, pool: Pool<Rgb8>, stop: Arc<AtomicBool>) -> Self {
        Self {
            camera,
            wish,
            stream: None,
            opened_at: clock.now(),
            clock,
            pool,
            stop,
            watch: CaptureWatch::default(),
            model: None,
            field_of_view: None,
            next: 0,
            last: None,
            sequence: None,
            retry_at: None,
            damaged_in_a_row: 0,
            signal_asked_at: None,
        }
    }

    /// The calibrated camera behind the pictures; it is left out for pictures of another size.
    #[must_use]
    pub fn with_model(mut self, model: Option<Arc<CameraModel>>) -> Self {
        self.model = model;
        self
    }

    /// Reads how it goes.
    pub fn watch(&self) -> CaptureWatch {
        self.watch.clone()
    }

    /// How the camera will deliver, asked before the line begins; `None` while it is absent.
    pub fn open_now(&mut self) -> Result<Option<Mode>, SourceError> {
        self.open()?;
        Ok(self.stream.as_ref().map(|stream| stream.mode()))
    }

    fn open(&mut self) -> Result<(), SourceError> {
        let now = self.clock.now();
        match self.camera.open(&self.wish) {
            Ok(stream) => {
                self.signal_asked_at = None;
                let mode = stream.mode();
                let mut status = self.watch.lock();
                status.opened += 1;
                let is_new = status.mode != Some(mode);
                status.mode = Some(mode);
                drop(status);
                if is_new {
                    self.tell_mode(&mode);
                }
                self.stream = Some(stream);
                (self.sequence, self.retry_at, self.opened_at) = (None, None, now);
                Ok(())
            }
            Err(CameraError::Absent(reason)) => {
                self.retry_at = Some(now + RETRY);
                self.set_state(CameraState::Absent(reason));
                Ok(())
            }
            Err(CameraError::Unusable(reason)) => Err(SourceError(reason)),
        }
    }

    fn tell_mode(&self, mode: &Mode) {
        tracing::info!("camera: {} delivers {mode}", self.camera.name());
        if let Some(size) = self.wish.size.filter(|size| *size != (mode.width, mode.height)) {
            tracing::warn!(
                "camera: asked for {}x{}, it delivers {}x{}; `endofield live --list` shows what it can",
                size.0,
                size.1,
                mode.width,
                mode.height
            );
        }
        if let Some(rate) = self.wish.frame_rate_hz.filter(|rate| (rate - mode.frame_rate_hz).abs() > 0.5)
            && mode.frame_rate_hz > 0.0
        {
            tracing::warn!(
                "camera: asked for {rate} frames a second, it delivers {:.2}",
                mode.frame_rate_hz
            );
        }
        if mode.interlaced {
            tracing::warn!("camera: it delivers interlaced pictures, which show combs on what moves; choose a progressive mode");
        }
        if let Some(model) = &self.model
            && (model.width, model.height) != (mode.width, mode.height)
        {
            tracing::warn!(
                "camera.yaml is for pictures of {}x{}: what needs it passes frames as they come",
                model.width,
                model.height
            );
        }
    }

    fn set_state(&self, state: CameraState) {
        let mut status = self.watch.lock();
        // The reason why a camera is not back yet may change; that it is gone has been told.
        if status.state.word() == state.word() {
            return;
        }
        if status.state == CameraState::Streaming {
            status.interruptions += 1;
        }
        let was_starting = status.state == CameraState::Starting;
        status.state = state.clone();
        drop(status);
        match state {
            CameraState::Absent(reason) => tracing::warn!("camera: {reason}; waiting for it"),
            CameraState::Stalled => tracing::warn!("camera: no frames come; trying to start it again"),
            CameraState::NoSignal => tracing::warn!("camera: no signal; is the endoscope switched on and its cable in?"),
            CameraState::Streaming if !was_starting => tracing::info!("camera: frames come again"),
            CameraState::Streaming | CameraState::Starting => {}
        }
    }

    /// Let the stream go. The driver's crate may panic when a stream that broke is dropped.
    fn close(&mut self) {
        let stream = self.stream.take();
        if catch_unwind(AssertUnwindSafe(|| drop(stream))).is_err() {
            tracing::debug!("camera: the broken stream could not be closed in order");
        }
    }

    fn lose(&mut self, error: &std::io::Error) {
        self.close();
        self.retry_at = Some(self.clock.now() + RETRY);
        let name = self.camera.name();
        self.set_state(CameraState::Absent(format!("{name} was lost ({error})")));
    }

    /// Nothing has come for a while.
    fn look_at_stall(&mut self) {
        let now = self.clock.now();
        // The next frame tells that they come again.
        self.signal_asked_at = None;
        let Some(stream) = &mut self.stream else { return };
        let limit = Span(stream.mode().period().0.saturating_mul(STALLED_PERIODS)).max(STALLED);
        let status = self.watch.lock();
        let silent_since = self.last.map_or(self.opened_at, |last| last.exposed_at.max(self.opened_at));
        let is_streaming = matches!(status.state, CameraState::Streaming | CameraState::Starting);
        drop(status);
        if is_streaming && now - silent_since < limit {
            return;
        }
        if stream.has_signal() == Some(false) {
            self.set_state(CameraState::NoSignal);
        } else {
            self.set_state(CameraState::Stalled);
        }
        if now - self.opened_at >= REOPEN && now - silent_since >= REOPEN {
            self.close();
        }
    }

    /// A frame that is there; `None` when it is no good.
    fn take(&mut self, arrived_at: Timestamp) -> std::io::Result<Option<Frame>> {
        let Some(stream) = &mut self.stream else { return Ok(None) };
        let mode = stream.mode();
        let mut image = self.pool.take(mode.width, mode.height);
        let mut seen = None;
        stream.take(&mut |bytes, stamp| {
            let verdict = match stamp.damaged {
                true => Verdict::Damaged,
                false => match rgb_from_bytes(bytes, &mode, &mut image) {
                    Ok(()) => Verdict::Good,
                    Err(error) => Verdict::Broken(error.to_string()),
                },
            };
            seen = Some((stamp, verdict));
        })?;
        let Some((stamp, mut verdict)) = seen else { return Ok(None) };
        // Old, and yet the newest there is: the driver is that slow, or its clock is another one.
        let is_old = stamp.at.is_some_and(|at| arrived_at - at > STALE);
        if verdict == Verdict::Good && is_old && stream.wait(Duration::ZERO)? {
            verdict = Verdict::Stale;
        }
        let missed = self.missed_before(&stamp, arrived_at, &mode);
        self.next += missed;
        let id = FrameId(self.next);
        self.next += 1;
        let mut status = self.watch.lock();
        status.missed += missed;
        match &verdict {
            Verdict::Good => status.frames += 1,
            Verdict::Damaged => status.damaged += 1,
            Verdict::Stale => status.stale += 1,
            Verdict::Broken(_) => status.broken += 1,
        }
        drop(status);
        if verdict != Verdict::Good {
            self.damaged_in_a_row += 1;
            if self.damaged_in_a_row == MANY_DAMAGED {
                tracing::warn!("camera: {MANY_DAMAGED} frames in a row were no good ({verdict}); check cable and connection");
            }
            return Ok(None);
        }
        self.damaged_in_a_row = 0;
        let exposed_at = stamp.at.filter(|at| *at <= arrived_at).unwrap_or(arrived_at);
        // Stamps that stand still would make time stand still for whoever differentiates by it.
        let exposed_at = self.last.map_or(exposed_at, |last| exposed_at.max(last.exposed_at + Span(1)));
        let mut frame = Frame::new(id, exposed_at, arrived_at, image);
        frame.since_previous = self.last.map_or(Span(0), |last| exposed_at - last.exposed_at);
        frame.camera = self
            .model
            .clone()
            .filter(|model| (model.width, model.height) == frame.image.size());
        frame.field_of_view = self.field_of_view.clone().filter(|mask| mask.size() == frame.image.size());
        self.last = Some(Last {
            exposed_at,
            period: mode.period(),
        });
        if self.signal_asked_at.is_none_or(|at| arrived_at - at >= SIGNAL_EVERY) {
            self.signal_asked_at = Some(arrived_at);
            let has_signal = self.stream.as_mut().and_then(|stream| stream.has_signal());
            self.set_state(match has_signal {
                Some(false) => CameraState::NoSignal,
                Some(true) | None => CameraState::Streaming,
            });
        }
        Ok(Some(frame))
    }

    /// Frames that are missing before one: by the driver's count, or by time when the stream is a new one.
    fn missed_before(&mut self, stamp: &Stamp, arrived_at: Timestamp, mode: &Mode) -> u64 {
        let previous = self.sequence.replace(stamp.sequence);
        if let Some(previous) = previous {
            let step = stamp.sequence.wrapping_sub(previous);
            // A driver that repeats a number, or counts anew, has skipped nothing that it tells of.
            return if step < u32::MAX / 2 {
                u64::from(step.saturating_sub(1))
            } else {
                0
            };
        }
        let Some(last) = self.last else { return 0 };
        let period = if mode.period() > Span(0) { mode.period() } else { last.period };
        let away = stamp.at.unwrap_or(arrived_at) - last.exposed_at;
        if period <= Span(0) {
            return 0;
        }
        let periods = (away.seconds() / period.seconds()).round() as u64;
        periods.saturating_sub(1)
    }
}

/// What a frame's bytes are worth.
#[derive(Clone, Debug, PartialEq)]
enum Verdict {
    Good,
    Damaged,
    Stale,
    Broken(String),
}

impl std::fmt::Display for Verdict {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Good => f.write_str("good"),
            Self::Damaged => f.write_str("the driver marks them damaged"),
            Self::Stale => f.write_str("they are old when they come"),
            Self::Broken(reason) => f.write_str(reason),
        }
    }
}

impl Source for CaptureSource {
    fn next_frame(&mut self) -> Result<Option<Frame>, SourceError> {
        while !self.stop.load(Ordering::Acquire) {
            let Some(stream) = &mut self.stream else {
                if self.retry_at.is_some_and(|at| self.clock.now() < at) {
                    self.camera.pause(WAIT);
                } else {
                    self.open()?;
                }
                continue;
            };
            if stream.wants_other_mode() {
                tracing::info!("camera: the signal's mode changed");
                self.close();
                continue;
            }
            match stream.wait(WAIT) {
                Ok(true) => match self.take(self.clock.now()) {
                    Ok(Some(frame)) => return Ok(Some(frame)),
                    Ok(None) => {}
                    Err(error) => self.lose(&error),
                },
                Ok(false) => self.look_at_stall(),
                Err(error) => self.lose(&error),
            }
        }
        Ok(None)
    }

    fn stamps_arrivals(&self) -> bool {
        true
    }
}
