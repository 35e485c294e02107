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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frame::FrameId;
    use crate::image::buffer::Image;
    use crate::time::Timestamp;

    /// A frame of plain tissue with one clipped droplet at `place`, a part of the left side out of the field.
    fn frame((width, height): (usize, usize), place: (usize, usize)) -> Frame {
        let mut image = Pool::new(1).take(width, height);
        image.fill([150, 70, 60]);
        for y in place.1 - 8..place.1 + 8 {
            image.row_mut(y)[place.0 - 8..place.0 + 8].fill([255; 3]);
        }
        let mut field = Image::filled(width, height, 255);
        for y in 0..height {
            field.row_mut(y)[..101].fill(0);
        }
        let mut frame = Frame::new(FrameId(0), Timestamp(0), Timestamp(0), image);
        frame.field_of_view = Some(Arc::new(field));
        frame
    }

    #[test]
    fn wide_pictures_are_looked_at_reduced_and_others_as_they_are() {
        for (size, step) in [((960, 540), 1), ((1280, 720), 1), ((1919, 1079), 2), ((2879, 1619), 3)] {
            let place = (size.0 / 2, size.1 / 2);
            let mut frame = frame(size, place);
            let mut stage = SpecularityDetection::new(&Settings::default());
            stage.process(&mut frame).unwrap();
            let seen = frame.analysis.as_ref().unwrap();
            let reduced = (size.0.div_ceil(step), size.1.div_ceil(step));
            assert_eq!((seen.step, seen.image(&frame.image).size()), (step, reduced));
            assert_eq!((seen.specularities.size(), seen.instruments.size()), (reduced, reduced));
            assert_eq!(seen.specularities.at(place.0 / step, place.1 / step), 255, "at {size:?}");
            let field = seen.field_of_view.as_ref().unwrap();
            // Column 100 is outside, and with it the square it lies in.
            assert_eq!((field.at(100 / step, 9), field.at(100 / step + 1, 9)), (0, 255));
            // The same field is not reduced again.
            let before = Arc::clone(field);
            stage.process(&mut frame).unwrap();
            let again = frame.analysis.as_ref().and_then(|seen| seen.field_of_view.as_ref());
            assert!(Arc::ptr_eq(&before, again.unwrap()));
        }
    }
}
