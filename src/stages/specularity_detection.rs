//! The pixels that show the lamp instead of the tissue, from the picture alone; what the light field knows is added later.

use crate::frame::Frame;
use crate::image::pool::Pool;
use crate::image::specularity::{Settings, SpecularityDetector};
use crate::pipeline::stage::{Stage, StageError};

/// Marks specularities and instruments.
#[derive(Debug)]
pub struct SpecularityDetection {
    detector: SpecularityDetector,
    masks: Pool<u8>,
}

impl SpecularityDetection {
    /// With the given settings.
    pub fn new(settings: &Settings) -> Self {
        Self {
            detector: SpecularityDetector::new(settings),
            masks: Pool::new(32),
        }
    }
}

impl Stage for SpecularityDetection {
    fn name(&self) -> &'static str {
        "specularity_detection"
    }

    fn process(&mut self, frame: &mut Frame) -> Result<(), StageError> {
        let (width, height) = frame.image.size();
        let (mut specular, mut instruments) = (self.masks.take(width, height), self.masks.take(width, height));
        self.detector
            .detect(&frame.image, frame.field_of_view.as_deref(), &mut specular, &mut instruments);
        frame.specularities = Some(specular);
        frame.instruments = Some(instruments);
        Ok(())
    }
}
