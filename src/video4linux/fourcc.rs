//! Layouts of pictures by the four letters that drivers know them by.

use v4l::FourCC;

use crate::media::layout::Layout;

/// A layout as drivers name it.
pub fn fourcc_of(layout: Layout) -> FourCC {
    FourCC::new(match layout {
        Layout::Yuyv => b"YUYV",
        Layout::Uyvy => b"UYVY",
        Layout::Nv12 => b"NV12",
        Layout::Mjpeg => b"MJPG",
        Layout::Rgb24 => b"RGB3",
        Layout::Bgr24 => b"BGR3",
    })
}

/// The layout a driver names; `None` when it is none that is read.
pub fn layout_of(fourcc: FourCC) -> Option<Layout> {
    if fourcc == FourCC::new(b"JPEG") {
        return Some(Layout::Mjpeg);
    }
    Layout::ALL.into_iter().find(|layout| fourcc_of(*layout) == fourcc)
}
