//! The pixels that show the lamp instead of the tissue, from the picture alone; what the light field knows is added later.

use crate::frame::Frame;
use crate::image::buffer::{Image, Mask};
use crate::image::pool::Pool;
use crate::image::specularity::{Settings, SpecularityDetector};
use crate::pipeline::stage::{Stage, StageError};

/// Marks specularities and instruments.
#[derive(Debug)]
pub struct SpecularityDetection {
    detector: SpecularityDetector,
    specular: Mask,
    instruments: Mask,
    masks: Pool<u8>,
}

impl SpecularityDetection {
    /// With the given settings.
    pub fn new(settings: &Settings) -> Self {
        let empty = || Image::filled(0, 0, 0);
        Self {
            detector: SpecularityDetector::new(settings),
            specular: empty(),
            instruments: empty(),
            masks: Pool::new(32),
        }
    }
}

impl Stage for SpecularityDetection {
    fn name(&self) -> &'static str {
        "specularity_detection"
    }

    fn process(&mut self, frame: &mut Frame) -> Result<(), StageError> {
        self.detector.detect(
            &frame.image,
            frame.field_of_view.as_deref(),
            &mut self.specular,
            &mut self.instruments,
        );
        frame.specularities = Some(self.masks.take_copy(&self.specular));
        frame.instruments = Some(self.masks.take_copy(&self.instruments));
        Ok(())
    }
}
