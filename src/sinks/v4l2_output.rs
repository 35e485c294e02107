//! An output node of Video4Linux2 as a screen: what is shown there, other programs read from its other side.

use std::io;
use std::path::{Path, PathBuf};
use std::time::Duration;

use v4l::capability::Flags as Capability;
use v4l::device::Device;
use v4l::format::{Colorspace, FieldOrder, Format, Quantization};
use v4l::video::Output as _;

use crate::image::buffer::{Image, Rgb8};
use crate::media::layout::{Layout, Matrix, lay_out};
use crate::sinks::virtual_camera::Screen;
use crate::video4linux::fourcc::fourcc_of;
use crate::video4linux::output::OutputBuffers;

/// One that is shown, one that comes next, one that is filled.
const BUFFERS: u32 = 3;
/// From so many lines on, colors are mixed by BT.709, as programs expect.
const HIGH_DEFINITION_LINES: usize = 720;

const ENOENT: i32 = 2;
const EACCES: i32 = 13;
const EBUSY: i32 = 16;
const ENODEV: i32 = 19;

/// An output node.
#[derive(Debug)]
pub struct V4l2Output {
    path: PathBuf,
    open: Option<Open>,
}

#[derive(Debug)]
struct Open {
    buffers: OutputBuffers,
    layout: Layout,
    matrix: Matrix,
    stride: usize,
}

impl V4l2Output {
    /// The node at `path`, there or not yet.
    pub fn new(path: &Path) -> Self {
        Self {
            path: path.to_owned(),
            open: None,
        }
    }

    fn said(&self, error: &io::Error) -> String {
        let path = self.path.display();
        match error.raw_os_error() {
            Some(ENOENT | ENODEV) => {
                format!("{path} is not there; `modprobe v4l2loopback` makes such a node (Debian package v4l2loopback-dkms)")
            }
            Some(EBUSY) => format!("{path} is in use by another program, or is being read in another format"),
            Some(EACCES) => format!("{path}: permission denied; cameras usually belong to the group `video`"),
            _ => format!("{path}: {error}"),
        }
    }

    fn opened(&self, (width, height): (usize, usize), layout: Layout) -> Result<Open, String> {
        let said = |error: io::Error| self.said(&error);
        let device = Device::with_path(&self.path).map_err(said)?;
        let can = device.query_caps().map_err(said)?.capabilities;
        if !can.contains(Capability::VIDEO_OUTPUT) {
            return Err(format!(
                "{}: expected a node that pictures can be shown on (v4l2loopback), found one that only delivers them",
                self.path.display()
            ));
        }
        let matrix = if height >= HIGH_DEFINITION_LINES {
            Matrix::Bt709
        } else {
            Matrix::Bt601
        };
        let mut asked = Format::new(width as u32, height as u32, fourcc_of(layout));
        asked.field_order = FieldOrder::Progressive;
        (asked.colorspace, asked.quantization) = match (layout, matrix) {
            (Layout::Rgb24 | Layout::Bgr24, _) => (Colorspace::SRGB, Quantization::FullRange),
            (_, Matrix::Bt709) => (Colorspace::Rec709, Quantization::LimitedRange),
            _ => (Colorspace::SMPTE170M, Quantization::LimitedRange),
        };
        let format = device.set_format(&asked).map_err(said)?;
        if (format.width, format.height, format.fourcc) != (asked.width, asked.height, asked.fourcc) {
            return Err(format!(
                "{}: expected it to take {width}x{height} {}, it insists on {}x{} {}; set the node, or virtual_camera.layout",
                self.path.display(),
                layout.name(),
                format.width,
                format.height,
                String::from_utf8_lossy(&format.fourcc.repr)
            ));
        }
        Ok(Open {
            buffers: OutputBuffers::new(&device, BUFFERS).map_err(said)?,
            layout,
            matrix,
            stride: format.stride as usize,
        })
    }
}

impl Screen for V4l2Output {
    fn name(&self) -> String {
        self.path.display().to_string()
    }

    fn open(&mut self, size: (usize, usize), layout: Layout) -> Result<(), String> {
        self.open = Some(self.opened(size, layout)?);
        Ok(())
    }

    fn show(&mut self, picture: &Image<Rgb8>, patience: Duration) -> io::Result<bool> {
        let Some(open) = &mut self.open else { return Ok(false) };
        let mut fits = true;
        let shown = open.buffers.show(patience, |bytes| {
            let row = open.layout.rows(picture.width(), 1).map_or(0, |(row, _)| row);
            fits = lay_out(picture, open.layout, open.matrix, open.stride.max(row), bytes);
        })?;
        if fits {
            Ok(shown)
        } else {
            Err(io::Error::other("the driver's buffers are too small for its own format"))
        }
    }

    fn close(&mut self) {
        self.open = None;
    }
}
