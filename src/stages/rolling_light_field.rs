//! The stage that gives the line a light field of its own last frames: it chooses which of them become views and says when a new light
//! field is to be made. It changes nothing in the picture.

use std::fmt;
use std::sync::Arc;

use crate::camera::model::CameraModel;
use crate::frame::{Analysis, Frame, FrameId};
use crate::image::buffer::Mask;
use crate::light_field::build::view_of;
use crate::light_field::rolling::{Batch, RollingViews, Settings};
use crate::light_field::selection::sharpness;
use crate::light_field::view::View;
use crate::pipeline::stage::{Stage, StageError};

/// Who makes light fields of the views. The frame is the first one they are for.
pub type Maker = Box<dyn FnMut(Batch, &CameraModel, FrameId) + Send>;

/// Collects views.
pub struct RollingLightField {
    views: RollingViews,
    maker: Maker,
}

impl RollingLightField {
    /// Whenever it is time for a new light field, `maker` is given the views.
    pub fn new(settings: &Settings, maker: Maker) -> Self {
        Self {
            views: RollingViews::new(settings),
            maker,
        }
    }
}

impl fmt::Debug for RollingLightField {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("RollingLightField")
            .field("views", &self.views)
            .finish_non_exhaustive()
    }
}

/// What is no tissue has no say.
fn silence(confidence: &mut Mask, analysis: &Analysis) {
    let foreign = analysis.specularities.pixels().iter().zip(analysis.instruments.pixels());
    for (confidence, (&specular, &instrument)) in confidence.pixels_mut().iter_mut().zip(foreign) {
        *confidence &= !(specular | instrument);
    }
    if let Some(field) = &analysis.field_of_view {
        for (confidence, &inside) in confidence.pixels_mut().iter_mut().zip(field.pixels()) {
            *confidence &= inside;
        }
    }
}

impl Stage for RollingLightField {
    fn name(&self) -> &'static str {
        "rolling_light_field"
    }

    fn process(&mut self, frame: &mut Frame) -> Result<(), StageError> {
        if frame.scene_cut {
            self.views.forget();
        }
        let (Some(analysis), Some(camera), Some(pose)) = (&frame.analysis, &frame.camera, &frame.world_from_camera) else {
            return Ok(());
        };
        let picture = analysis.image(&frame.image);
        if !self.views.is_wanted(frame.exposed_at, pose, sharpness(picture)) {
            return Ok(());
        }
        let camera = camera.reduced(analysis.step);
        let number = u32::try_from(frame.id.0).map_err(|_| StageError("more frames than can be numbered".into()))?;
        let mut view: View = view_of(number, frame.exposed_at, picture, &camera, *pose);
        view.camera = Arc::new(camera.clone());
        silence(&mut view.confidence, analysis);
        self.views.join(view);
        if let Some(batch) = self.views.due() {
            (self.maker)(batch, &camera, frame.id);
        }
        Ok(())
    }

    fn reset(&mut self) {
        self.views.forget();
    }
}
