//! The arm's pose corrected by the picture: a degree of joint error is thirty pixels of tissue, so the arm is only a prior.
//!
//! The correction of one frame starts the next: what the arm gets wrong (its clock, its joints) changes slowly. Without an arm, the
//! last pose starts the next, and a frame that is lost is looked for among the light field's views.

use std::sync::Arc;

use crate::frame::{Alignment, Analysis, Frame, PoseOrigin};
use crate::geometry::space::{Camera, World};
use crate::geometry::transform::Transform;
use crate::image::blur::BlurScratch;
use crate::light_field::view::LightField;
use crate::localization::detail::{DetailPyramid, Usable};
use crate::localization::image_alignment::{self, ImageAligner};
use crate::pipeline::slot::Slot;
use crate::pipeline::stage::{Stage, StageError};

/// How far the picture may overrule the arm.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// A refined pose farther than this from the arm's is not believed, mm.
    pub max_correction_mm: f64,
    /// A refined pose turned more than this from the arm's is not believed, rad.
    pub max_correction_rad: f64,
    /// How a picture is laid against the views.
    pub alignment: image_alignment::Settings,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            max_correction_mm: 12.0,
            max_correction_rad: 0.12,
            alignment: image_alignment::Settings::default(),
        }
    }
}

/// A light field, made ready for pictures to be laid against it.
#[derive(Debug)]
pub struct Reference {
    light_field: Arc<LightField>,
    aligner: ImageAligner,
}

impl Reference {
    /// The work of all views' pictures: not for a running line's thread.
    pub fn new(light_field: Arc<LightField>, settings: &Settings) -> Self {
        Self {
            aligner: ImageAligner::new(&light_field, &settings.alignment),
            light_field,
        }
    }
}

/// Corrects `frame.world_from_camera`.
#[derive(Debug)]
pub struct PoseRefinement {
    settings: Settings,
    reference: Option<Reference>,
    /// Where a newer light field comes.
    newer: Slot<Reference>,
    pyramid: DetailPyramid,
    scratch: BlurScratch,
    /// Right-multiplied to the arm's pose: refined = arm · correction.
    correction: Option<Transform<Camera, Camera>>,
    last: Option<Transform<World, Camera>>,
}

impl PoseRefinement {
    /// Against the given light field.
    pub fn new(settings: &Settings, light_field: Arc<LightField>) -> Self {
        Self {
            reference: Some(Reference::new(light_field, settings)),
            ..Self::awaiting(settings, Slot::new())
        }
    }

    /// No frame is aligned until a light field comes; every newer one is taken from then on.
    pub fn awaiting(settings: &Settings, newer: Slot<Reference>) -> Self {
        Self {
            settings: settings.clone(),
            reference: None,
            newer,
            pyramid: DetailPyramid::default(),
            scratch: BlurScratch::default(),
            correction: None,
            last: None,
        }
    }

    /// The best start among the arm's pose, that pose with the last correction, and the last pose.
    fn best_guess(
        &self,
        reference: &mut Reference,
        frame: &Frame,
        camera: &crate::camera::model::CameraModel,
    ) -> Option<Transform<World, Camera>> {
        let Reference { light_field, aligner } = reference;
        let prior = frame.world_from_camera;
        let corrected = prior.zip(self.correction).map(|(arm, correction)| arm * correction);
        let mut best: Option<(f32, Transform<World, Camera>)> = None;
        for pose in [corrected, prior, self.last].into_iter().flatten() {
            let score = aligner.coarse_score(&self.pyramid, camera, &pose);
            if best.is_none_or(|(found, _)| score > found) {
                best = Some((score, pose));
            }
        }
        if best.is_none_or(|(score, _)| score < 0.1) && prior.is_none() {
            for view in &light_field.views {
                let pose = view.world_from_camera;
                let score = aligner.coarse_score(&self.pyramid, camera, &pose);
                if best.is_none_or(|(found, _)| score > found) {
                    best = Some((score, pose));
                }
            }
        }
        best.map(|(_, pose)| pose)
    }

    fn is_believable(&self, refined: &Transform<World, Camera>, prior: Option<&Transform<World, Camera>>) -> bool {
        prior.is_none_or(|prior| {
            let away = prior.inverse() * *refined;
            away.translation().norm() <= self.settings.max_correction_mm
                && away.rotation().angle() <= self.settings.max_correction_rad
        })
    }
}

/// Tissue without the lamp's mirror image, inside the image field.
fn usable_in(analysis: &Analysis) -> Usable<'_> {
    Usable {
        without: [Some(&analysis.specularities), Some(&analysis.instruments)],
        within: analysis.field_of_view.as_deref().map(|field| (field, 0)),
    }
}

impl Stage for PoseRefinement {
    fn name(&self) -> &'static str {
        "pose_refinement"
    }

    fn process(&mut self, frame: &mut Frame) -> Result<(), StageError> {
        let Some(camera) = frame.camera.clone() else {
            return Err(StageError(
                "the frame has no calibrated camera: give the recording a camera.yaml".into(),
            ));
        };
        if frame.scene_cut {
            self.reset();
        }
        let Some(analysis) = &frame.analysis else {
            if frame.timings.iter().any(|timing| timing.bypassed) {
                // Live, the detection rests or was passed by for lack of time: nothing is known of this picture.
                frame.alignment = Some(Alignment::default());
                return Ok(());
            }
            return Err(StageError(
                "no specularity mask: the detection stage must run before the pose refinement".into(),
            ));
        };
        if let Some(newer) = self.newer.take(frame.id) {
            self.reference = Some(newer);
        }
        let Some(mut reference) = self.reference.take() else {
            frame.alignment = Some(Alignment::default());
            return Ok(());
        };
        let step = analysis.step;
        let camera = camera.reduced(step);
        self.pyramid
            .build(analysis.image(&frame.image), &usable_in(analysis), &mut self.scratch);
        let prior = frame.world_from_camera;
        let guess = self.best_guess(&mut reference, frame, &camera);
        let aligned = guess
            .and_then(|guess| reference.aligner.align(&self.pyramid, &camera, &guess, prior.as_ref()))
            .filter(|found| self.is_believable(&found.world_from_camera, prior.as_ref()));
        self.reference = Some(reference);
        let Some(found) = aligned else {
            frame.alignment = Some(Alignment::default());
            self.last = None;
            return Ok(());
        };
        self.correction = prior.map(|prior| prior.inverse() * found.world_from_camera);
        self.last = Some(found.world_from_camera);
        if prior.is_none() {
            frame.pose_origin = PoseOrigin::Predicted;
        }
        let correction_px = prior.map_or(0.0, |prior| {
            let away = prior.inverse() * found.world_from_camera;
            // A turn moves the whole picture; a shift moves it by what it is at the scene, which `moved_px` measured from the guess.
            step as f32 * found.moved_px.max((camera.intrinsics.fx * away.rotation().angle()) as f32)
        });
        frame.world_from_camera = Some(found.world_from_camera);
        frame.alignment = Some(Alignment {
            correlation: found.correlation,
            correction_px,
            aligned: true,
            ..Alignment::default()
        });
        Ok(())
    }

    fn reset(&mut self) {
        self.correction = None;
        self.last = None;
    }
}
