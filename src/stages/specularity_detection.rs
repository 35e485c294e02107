//! The pixels that show the lamp instead of the tissue, from the picture alone; what the light field knows is added later.

use std::sync::Arc;

use crate::frame::{Analysis, Frame};
use crate::image::buffer::{Mask, Rgb8};
use crate::image::pool::Pool;
use crate::image::reduction::{least_of_squares, mean_of_squares, reduced_size, reduction_for};
use crate::image::specularity::{Settings, SpecularityDetector};
use crate::pipeline::stage::{Stage, StageError};

/// Marks specularities and instruments, in the picture reduced to the size at which it is looked at.
#[derive(Debug)]
pub struct SpecularityDetection {
    detector: SpecularityDetector,
    pictures: Pool<Rgb8>,
    masks: Pool<u8>,
    /// The image field, and what it is at the reduced size.
    field: Option<(Arc<Mask>, Arc<Mask>)>,
}

impl SpecularityDetection {
    /// With the given settings.
    pub fn new(settings: &Settings) -> Self {
        Self {
            detector: SpecularityDetector::new(settings),
            pictures: Pool::new(32),
            masks: Pool::new(32),
            field: None,
        }
    }

    /// The image field of a frame, reduced; made anew only when another field is found.
    fn reduced_field(&mut self, field: Option<&Arc<Mask>>, step: usize) -> Option<Arc<Mask>> {
        let field = field?;
        if step == 1 {
            return Some(Arc::clone(field));
        }
        if let Some((known, reduced)) = &self.field
            && Arc::ptr_eq(known, field)
        {
            return Some(Arc::clone(reduced));
        }
        let reduced = Arc::new(least_of_squares(field, step));
        self.field = Some((Arc::clone(field), Arc::clone(&reduced)));
        Some(reduced)
    }
}

impl Stage for SpecularityDetection {
    fn name(&self) -> &'static str {
        "specularity_detection"
    }

    fn process(&mut self, frame: &mut Frame) -> Result<(), StageError> {
        let step = reduction_for(frame.image.width());
        let (width, height) = reduced_size(frame.image.size(), step);
        let field_of_view = self.reduced_field(frame.field_of_view.as_ref(), step);
        let reduced = (step > 1).then(|| {
            let mut reduced = self.pictures.take(width, height);
            mean_of_squares(&frame.image, step, &mut reduced);
            reduced
        });
        let (mut specularities, mut instruments) = (self.masks.take(width, height), self.masks.take(width, height));
        let image = reduced.as_deref().unwrap_or(&frame.image);
        self.detector
            .detect(image, field_of_view.as_deref(), &mut specularities, &mut instruments);
        frame.analysis = Some(Analysis {
            step,
            reduced,
            field_of_view,
            specularities,
            instruments,
        });
        Ok(())
    }
}
