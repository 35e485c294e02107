//! Shows the enhanced picture to other programs as a camera. A node that is not there, is taken, or fails is tried again; the line
//! never waits for it.

use std::io;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use serde::{Deserialize, Serialize};

use crate::frame::Frame;
use crate::image::buffer::{Image, Rgb8};
use crate::media::layout::Layout;
use crate::pipeline::stage::{Sink, SinkError};
use crate::time::{Span, Timestamp};

/// A node that failed is tried again this often.
const RETRY: Span = Span(1_000_000_000);
/// A buffer of the driver's is waited for no longer than this.
const PATIENCE: Duration = Duration::from_millis(50);

/// Layouts as a user names them.
const LAYOUTS: [(&str, Layout); 3] = [("yuyv", Layout::Yuyv), ("rgb24", Layout::Rgb24), ("bgr24", Layout::Bgr24)];

/// How other programs see the picture.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// How pictures lie in memory.
    pub layout: String,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            layout: "yuyv".to_owned(),
        }
    }
}

impl Settings {
    /// What is out of bounds: key, value and bound.
    pub fn check(&self) -> Result<(), String> {
        self.layout().map(|_| ())
    }

    /// As the driver wants it.
    pub fn layout(&self) -> Result<Layout, String> {
        let known = LAYOUTS.iter().find(|(name, _)| *name == self.layout);
        known.map(|(_, layout)| *layout).ok_or_else(|| {
            let names = LAYOUTS.map(|(name, _)| name).join(", ");
            format!("virtual_camera.layout: expected {names}, found `{}`", self.layout)
        })
    }
}

/// Somewhere to show pictures.
pub trait Screen: Send {
    /// What it is called.
    fn name(&self) -> String;
    /// Be ready for pictures of this size; a message when that cannot be.
    fn open(&mut self, size: (usize, usize), layout: Layout) -> Result<(), String>;
    /// Show one; false when there was no room for it in time.
    fn show(&mut self, picture: &Image<Rgb8>, patience: Duration) -> io::Result<bool>;
    /// Let go.
    fn close(&mut self);
}

/// How it goes.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct VirtualCameraStatus {
    /// Pictures handed to the driver.
    pub shown: u64,
    /// Pictures it did not take.
    pub lost: u64,
    /// Times it was opened.
    pub opened: u64,
    /// Why it shows nothing now.
    pub failure: Option<String>,
}

/// Reads what a [`VirtualCameraSink`] does.
#[derive(Clone, Debug, Default)]
pub struct VirtualCameraReading(Arc<Mutex<VirtualCameraStatus>>);

impl VirtualCameraReading {
    /// Everything so far.
    pub fn get(&self) -> VirtualCameraStatus {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    fn change<T>(&self, change: impl FnOnce(&mut VirtualCameraStatus) -> T) -> T {
        change(&mut self.0.lock().unwrap_or_else(PoisonError::into_inner))
    }
}

/// Shows every frame it is given.
pub struct VirtualCameraSink {
    screen: Box<dyn Screen>,
    layout: Layout,
    size: Option<(usize, usize)>,
    retry_at: Option<Timestamp>,
    reading: VirtualCameraReading,
}

impl std::fmt::Debug for VirtualCameraSink {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("VirtualCameraSink")
            .field("screen", &self.screen.name())
            .field("status", &self.reading.get())
            .finish_non_exhaustive()
    }
}

impl VirtualCameraSink {
    /// The node is opened with the first picture.
    pub fn new(screen: Box<dyn Screen>, layout: Layout) -> Self {
        Self {
            screen,
            layout,
            size: None,
            retry_at: None,
            reading: VirtualCameraReading::default(),
        }
    }

    /// Reads how it goes.
    pub fn reading(&self) -> VirtualCameraReading {
        self.reading.clone()
    }

    fn close(&mut self) {
        if self.size.take().is_some() {
            self.screen.close();
        }
    }

    fn show(&mut self, frame: &Frame) -> Result<bool, String> {
        let size = frame.image.size();
        if self.size.is_some_and(|open| open != size) {
            self.close();
        }
        if self.size.is_none() {
            self.screen.open(size, self.layout)?;
            self.size = Some(size);
            let was_failing = self.reading.change(|status| {
                status.opened += 1;
                status.failure.take().is_some()
            });
            if was_failing {
                tracing::info!("virtual camera: {} shows the picture again", self.screen.name());
            }
        }
        let shown = self.screen.show(&frame.image, PATIENCE);
        shown.map_err(|error| format!("{} was lost ({error})", self.screen.name()))
    }
}

impl Sink for VirtualCameraSink {
    fn name(&self) -> &'static str {
        "virtual camera"
    }

    fn consume(&mut self, frame: &Arc<Frame>) -> Result<(), SinkError> {
        let rests = self.retry_at.is_some_and(|at| frame.exposed_at < at);
        let shown = if rests { Ok(false) } else { self.show(frame) };
        match shown {
            Ok(shown) => self.reading.change(|status| {
                status.shown += u64::from(shown);
                status.lost += u64::from(!shown);
            }),
            Err(reason) => {
                self.close();
                self.retry_at = Some(frame.exposed_at + RETRY);
                let is_new = self.reading.change(|status| {
                    status.lost += 1;
                    status.failure.replace(reason.clone()).is_none()
                });
                if is_new {
                    tracing::error!("virtual camera: {reason}; tried again every second");
                }
            }
        }
        Ok(())
    }

    fn finish(&mut self) -> Result<(), SinkError> {
        self.close();
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frame::FrameId;
    use crate::image::pool::Pool;

    /// A node that other programs take away and that fails at some pictures.
    #[derive(Clone, Default)]
    struct Played {
        shown: Arc<Mutex<Vec<(usize, u8)>>>,
        open: Option<(usize, usize)>,
        taken_until: usize,
        openings: usize,
    }

    impl Screen for Played {
        fn name(&self) -> String {
            "played".to_owned()
        }

        fn open(&mut self, size: (usize, usize), _layout: Layout) -> Result<(), String> {
            assert_eq!(self.open, None, "let go before");
            self.openings += 1;
            if self.openings <= self.taken_until {
                return Err("played is in use by another program".to_owned());
            }
            self.open = Some(size);
            Ok(())
        }

        fn show(&mut self, picture: &Image<Rgb8>, _patience: Duration) -> io::Result<bool> {
            assert_eq!(self.open, Some(picture.size()));
            let level = picture.at(0, 0)[0];
            if level == 99 {
                return Err(io::Error::from_raw_os_error(19));
            }
            if level == 98 {
                return Ok(false);
            }
            self.shown.lock().unwrap().push((picture.width(), level));
            Ok(true)
        }

        fn close(&mut self) {
            self.open = None;
        }
    }

    fn frame(at_s: f64, width: usize, level: u8) -> Arc<Frame> {
        let mut image = Pool::new(1).take(width, 2);
        image.fill([level; 3]);
        let at = Timestamp::from_seconds(at_s);
        Arc::new(Frame::new(FrameId(0), at, at, image))
    }

    #[test]
    fn a_node_that_is_taken_fails_or_is_given_another_size_never_ends_the_line() {
        let screen = Played {
            taken_until: 1,
            ..Played::default()
        };
        let shown = Arc::clone(&screen.shown);
        let mut sink = VirtualCameraSink::new(Box::new(screen), Layout::Yuyv);
        let reading = sink.reading();
        let mut play = |at_s: f64, width: usize, level: u8| sink.consume(&frame(at_s, width, level)).unwrap();
        play(0.0, 4, 1);
        assert!(reading.get().failure.unwrap().contains("in use"));
        play(0.5, 4, 2);
        play(1.0, 4, 3);
        play(1.1, 4, 98);
        play(1.2, 6, 4);
        play(1.3, 6, 99);
        assert!(reading.get().failure.unwrap().contains("was lost"));
        play(1.4, 6, 5);
        play(2.4, 6, 6);
        assert_eq!(*shown.lock().unwrap(), [(4, 3), (6, 4), (6, 6)]);
        let status = reading.get();
        assert_eq!((status.shown, status.lost, status.opened, status.failure), (3, 5, 3, None));
    }

    #[test]
    fn layouts_are_named() {
        let wrong = Settings {
            layout: "h264".to_owned(),
        };
        assert!(wrong.check().unwrap_err().contains("yuyv, rgb24, bgr24"));
        assert_eq!(Settings::default().layout(), Ok(Layout::Yuyv));
    }
}
