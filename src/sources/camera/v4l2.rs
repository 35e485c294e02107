//! Cameras and capture cards through Video4Linux2.
//!
//! The crate's own `next()` blocks for ever when no frame comes, and after a time-out of its own never works again. So the handle is
//! polled with our deadline first, and `next()` called only when a frame is there. Its first call would queue all buffers and
//! start; to poll before, all but the first are queued by hand and the stream is started, which is the state `next()` expects.
//! What a driver was asked for is compared with what it says it does by whoever opens it.

use std::io;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use v4l::buffer::{Flags, Type};
use v4l::capability::Flags as Capability;
use v4l::device::{Device, Handle};
use v4l::format::{Colorspace, FieldOrder, Quantization};
use v4l::frameinterval::FrameIntervalEnum;
use v4l::framesize::FrameSizeEnum;
use v4l::io::mmap::Stream as Mapped;
use v4l::io::traits::{CaptureStream as _, Stream as _};
use v4l::video::Capture as _;
use v4l::video::capture::Parameters;
use v4l::{Format, FourCC, Fraction};

use crate::media::layout::{Layout, Matrix, Range};
use crate::sources::camera::device::{Camera, CameraError, Mode, Stamp, Stream, Wish};
use crate::time::Timestamp;
use crate::video4linux::fourcc::{fourcc_of, layout_of};
use crate::video4linux::signal;

/// Buffers that the driver fills in turn: one is read, one is filled, two are in reserve.
const BUFFERS: u32 = 4;
/// From so many lines on, colors that the driver says nothing about are taken for BT.709.
const HIGH_DEFINITION_LINES: usize = 720;
/// Poll's event: there is something to read.
const READABLE: i16 = 1;

/// A device node that can deliver pictures.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Node {
    /// `/dev/video0`, say.
    pub path: PathBuf,
    /// What the device calls itself.
    pub card: String,
    /// Where it is plugged in.
    pub bus: String,
}

fn node_at(path: &Path) -> Option<Node> {
    let device = Device::with_path(path).ok()?;
    let capabilities = catch_unwind(AssertUnwindSafe(|| device.query_caps())).ok()?.ok()?;
    capabilities
        .capabilities
        .contains(Capability::VIDEO_CAPTURE | Capability::STREAMING)
        .then(|| Node {
            path: path.to_owned(),
            card: capabilities.card,
            bus: capabilities.bus,
        })
}

/// All nodes that can deliver pictures, in the order of their names.
pub fn nodes() -> Vec<Node> {
    let Ok(entries) = std::fs::read_dir("/dev") else {
        return Vec::new();
    };
    let is_video = |path: &PathBuf| {
        let name = path.file_name().map(|name| name.to_string_lossy().into_owned());
        name.is_some_and(|name| name.strip_prefix("video").is_some_and(|rest| rest.parse::<u32>().is_ok()))
    };
    let mut paths: Vec<PathBuf> = entries.flatten().map(|entry| entry.path()).filter(is_video).collect();
    paths.sort_by_key(|path| (path.as_os_str().len(), path.clone()));
    paths.iter().filter_map(|path| node_at(path)).collect()
}

/// What a device can deliver, a line each: layout, size, rates.
pub fn modes_of(node: &Node) -> Vec<String> {
    let Ok(device) = Device::with_path(&node.path) else {
        return Vec::new();
    };
    let listed = catch_unwind(AssertUnwindSafe(|| {
        let mut lines = Vec::new();
        for description in device.enum_formats().unwrap_or_default() {
            let known = layout_of(description.fourcc).is_some();
            let name = String::from_utf8_lossy(&description.fourcc.repr).into_owned();
            if !known {
                lines.push(format!("{name}  ({}; not read by endofield)", description.description));
                continue;
            }
            for size in device.enum_framesizes(description.fourcc).unwrap_or_default() {
                lines.push(format!("{name}  {}", size_line(&device, description.fourcc, size.size)));
            }
        }
        lines
    }));
    listed.unwrap_or_default()
}

fn size_line(device: &Device, fourcc: FourCC, size: FrameSizeEnum) -> String {
    match size {
        FrameSizeEnum::Discrete(size) => {
            let intervals = device
                .enum_frameintervals(fourcc, size.width, size.height)
                .unwrap_or_default();
            let rates: Vec<String> = intervals.into_iter().map(|interval| rate_words(&interval.interval)).collect();
            format!("{}x{}  {}", size.width, size.height, rates.join(", "))
        }
        FrameSizeEnum::Stepwise(range) => format!(
            "{}x{} to {}x{}",
            range.min_width, range.min_height, range.max_width, range.max_height
        ),
    }
}

fn rate_words(interval: &FrameIntervalEnum) -> String {
    let hz = |interval: &Fraction| {
        format!("{:.4}", rate_of(interval))
            .trim_end_matches('0')
            .trim_end_matches('.')
            .to_owned()
    };
    match interval {
        FrameIntervalEnum::Discrete(interval) => format!("{} Hz", hz(interval)),
        FrameIntervalEnum::Stepwise(range) => format!("{} to {} Hz", hz(&range.max), hz(&range.min)),
    }
}

fn rate_of(interval: &Fraction) -> f64 {
    if interval.numerator == 0 {
        return 0.0;
    }
    f64::from(interval.denominator) / f64::from(interval.numerator)
}

/// A camera by its node, which is found again under another number.
#[derive(Debug)]
pub struct V4l2Camera {
    path: PathBuf,
    /// As it was when it was first open.
    identity: Option<Node>,
}

impl V4l2Camera {
    /// The camera behind a node, there or not yet.
    pub fn new(path: &Path) -> Self {
        Self {
            path: path.to_owned(),
            identity: None,
        }
    }

    /// The node that leads to the camera now: the one it was given, or another one to the same device in the same place.
    fn present_path(&self) -> PathBuf {
        let Some(identity) = &self.identity else {
            return self.path.clone();
        };
        let is_it = |node: &Node| node.card == identity.card && node.bus == identity.bus;
        let same = node_at(&self.path).filter(is_it).map(|node| node.path);
        same.or_else(|| nodes().into_iter().find(is_it).map(|node| node.path))
            .unwrap_or_else(|| self.path.clone())
    }

    fn absent(&self, path: &Path, error: &io::Error) -> CameraError {
        let path = path.display();
        CameraError::Absent(match error.raw_os_error() {
            Some(ENOENT | ENODEV | ENXIO) => {
                format!("{path} is not there; is the camera plugged in? (`endofield live --list` names those that are)")
            }
            Some(EBUSY) => format!("{path} is in use by another program"),
            Some(EACCES | EPERM) => format!("{path}: permission denied; cameras usually belong to the group `video`"),
            _ => format!("{path}: {error}"),
        })
    }
}

const EPERM: i32 = 1;
const ENOENT: i32 = 2;
const ENXIO: i32 = 6;
const EACCES: i32 = 13;
const EBUSY: i32 = 16;
const ENODEV: i32 = 19;

impl Camera for V4l2Camera {
    fn name(&self) -> String {
        match &self.identity {
            Some(node) => format!("{} ({})", node.card, self.path.display()),
            None => self.path.display().to_string(),
        }
    }

    fn open(&mut self, wish: &Wish) -> Result<Box<dyn Stream>, CameraError> {
        let path = self.present_path();
        let device = Device::with_path(&path).map_err(|error| self.absent(&path, &error))?;
        // The crate panics on what it does not know: a color space from a newer kernel, say.
        let opened = catch_unwind(AssertUnwindSafe(|| V4l2Stream::open(device, wish)));
        let stream = match opened {
            Ok(Ok(stream)) => stream,
            Ok(Err(OpenFault::System(error))) => return Err(self.absent(&path, &error)),
            Ok(Err(OpenFault::Unusable(reason))) => return Err(CameraError::Unusable(format!("{}: {reason}", path.display()))),
            Err(_) => {
                let reason = "its driver says something that the crate `v4l` does not know; see the messages above";
                return Err(CameraError::Unusable(format!("{}: {reason}", path.display())));
            }
        };
        if path != self.path {
            tracing::info!("camera: it is {} now", path.display());
            self.path.clone_from(&path);
        }
        self.identity = node_at(&path).or(self.identity.take());
        Ok(Box::new(stream))
    }
}

enum OpenFault {
    System(io::Error),
    Unusable(String),
}

impl From<io::Error> for OpenFault {
    fn from(error: io::Error) -> Self {
        Self::System(error)
    }
}

/// A stream of mapped buffers.
struct V4l2Stream {
    mapped: Mapped<'static>,
    handle: Arc<Handle>,
    mode: Mode,
    /// Whether the driver says when another signal comes in.
    tells_changes: bool,
}

/// The layout to ask for: the one that is wished, or the best of those that are quick enough at the size.
fn chosen_layout(device: &Device, wish: &Wish, (width, height): (usize, usize)) -> Result<Layout, OpenFault> {
    let offered: Vec<FourCC> = device.enum_formats()?.into_iter().map(|format| format.fourcc).collect();
    let known = |layout: &Layout| offered.contains(&fourcc_of(*layout));
    if let Some(layout) = wish.layout {
        return Ok(layout);
    }
    let rate = wish.frame_rate_hz.unwrap_or(25.0);
    // Uncompressed pictures over a slow cable come slowly: one that is quick enough is better than one that is cheap to read.
    let is_quick = |layout: &Layout| {
        let intervals = device.enum_frameintervals(fourcc_of(*layout), width as u32, height as u32);
        intervals.unwrap_or_default().iter().any(|interval| match &interval.interval {
            FrameIntervalEnum::Discrete(interval) => rate_of(interval) > rate - 0.5,
            FrameIntervalEnum::Stepwise(range) => rate_of(&range.min) > rate - 0.5,
        })
    };
    let mut of_use = Layout::ALL.into_iter().filter(known);
    of_use.clone().find(is_quick).or_else(|| of_use.next()).ok_or_else(|| {
        let found: Vec<String> = offered
            .iter()
            .map(|code| String::from_utf8_lossy(&code.repr).into_owned())
            .collect();
        let expected: Vec<&str> = Layout::ALL.iter().map(|layout| layout.name()).collect();
        OpenFault::Unusable(format!(
            "expected a layout among {}, the camera offers {}; another capture card or mode is needed",
            expected.join(", "),
            found.join(", ")
        ))
    })
}

impl V4l2Stream {
    fn open(device: Device, wish: &Wish) -> Result<Self, OpenFault> {
        // A capture card's size is its signal's; the wish holds for what can choose.
        let of_signal = signal::follow(&device.handle());
        let present = device.format()?;
        let present = (present.width as usize, present.height as usize);
        let (width, height) = of_signal.or(wish.size).unwrap_or(present);
        let layout = chosen_layout(&device, wish, (width, height))?;
        let mut asked = Format::new(width as u32, height as u32, fourcc_of(layout));
        asked.field_order = FieldOrder::Progressive;
        let format = device.set_format(&asked)?;
        let Some(layout) = layout_of(format.fourcc) else {
            return Err(OpenFault::Unusable(format!(
                "asked for {}, its driver insists on {}, which is not read",
                layout.name(),
                String::from_utf8_lossy(&format.fourcc.repr)
            )));
        };
        if let Some(rate) = wish.frame_rate_hz {
            let interval = Fraction::new(1000, (rate * 1e3).round() as u32);
            // A driver without rates of its own says no; what it does is asked next.
            if let Err(error) = device.set_params(&Parameters::new(interval)) {
                tracing::debug!("camera: its rate cannot be set ({error})");
            }
        }
        let rate = device.params().map_or(0.0, |parameters| rate_of(&parameters.interval));
        let mode = mode_of(&format, layout, rate);
        let mut mapped = Mapped::with_buffers(&device, Type::VideoCapture, BUFFERS)?;
        let handle = mapped.handle();
        for index in 1..BUFFERS as usize {
            match mapped.queue(index) {
                // The driver gave fewer than it was asked for.
                Err(error) if error.kind() == io::ErrorKind::InvalidInput && index > 1 => break,
                queued => queued?,
            }
        }
        let tells_changes = signal::tell_changes(&handle).is_ok();
        mapped.start()?;
        Ok(Self {
            mapped,
            handle,
            mode,
            tells_changes,
        })
    }
}

fn mode_of(format: &Format, layout: Layout, frame_rate_hz: f64) -> Mode {
    let height = format.height as usize;
    let matrix = match format.colorspace {
        Colorspace::Rec709 => Matrix::Bt709,
        Colorspace::Rec2020 => Matrix::Bt2020,
        Colorspace::Default if height >= HIGH_DEFINITION_LINES => Matrix::Bt709,
        // Video4Linux2: what has no matrix of its own, sRGB among them, is mixed by BT.601.
        _ => Matrix::Bt601,
    };
    let range = match (format.quantization, format.colorspace) {
        (Quantization::FullRange, _) | (Quantization::Default, Colorspace::JPEG) => Range::Full,
        _ => Range::Limited,
    };
    Mode {
        width: format.width as usize,
        height,
        layout,
        stride: format.stride as usize,
        matrix,
        range,
        frame_rate_hz,
        interlaced: !matches!(format.field_order, FieldOrder::Progressive | FieldOrder::Any),
    }
}

impl Stream for V4l2Stream {
    fn mode(&self) -> Mode {
        self.mode
    }

    fn wait(&mut self, patience: Duration) -> io::Result<bool> {
        let milliseconds = i32::try_from(patience.as_millis()).unwrap_or(i32::MAX);
        match self.handle.poll(READABLE, milliseconds) {
            Ok(ready) => Ok(ready > 0),
            Err(error) if error.kind() == io::ErrorKind::Interrupted => Ok(false),
            Err(error) => Err(error),
        }
    }

    fn take(&mut self, taken: &mut dyn FnMut(&[u8], Stamp)) -> io::Result<()> {
        let (buffer, told) = self.mapped.next()?;
        let bytes = buffer.get(..told.bytesused as usize).unwrap_or(buffer);
        let is_ours = told.flags & Flags::TIMESTAMP_MASK == Flags::TIMESTAMP_MONOTONIC;
        let at = Timestamp(told.timestamp.sec * 1_000_000_000 + told.timestamp.usec * 1_000);
        let stamp = Stamp {
            at: is_ours.then_some(at),
            sequence: told.sequence,
            damaged: told.flags.contains(Flags::ERROR),
        };
        taken(bytes, stamp);
        Ok(())
    }

    fn has_signal(&mut self) -> Option<bool> {
        signal::is_there(&self.handle)
    }

    fn wants_other_mode(&mut self) -> bool {
        self.tells_changes && signal::has_changed(&self.handle)
    }
}
