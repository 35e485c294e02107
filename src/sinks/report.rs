//! What was done to each frame, in figures: the per-frame part of `--report`.

use std::sync::{Arc, Mutex, PoisonError};

use serde::Serialize;

use crate::camera::model::CameraModel;
use crate::frame::{Frame, PoseOrigin, provenance_code};
use crate::pipeline::stage::{Sink, SinkError};

/// Share of a frame's pixels, 0–1, per value of the mask.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct MaskShares {
    /// As the camera saw them.
    #[serde(rename = "0")]
    pub untouched: f64,
    /// Specularities left as they were.
    #[serde(rename = "64")]
    pub left: f64,
    /// Filled from recent frames.
    #[serde(rename = "128")]
    pub recent: f64,
    /// Made up.
    #[serde(rename = "192")]
    pub made_up: f64,
    /// Filled from the light field.
    #[serde(rename = "255")]
    pub light_field: f64,
}

/// What was done to one frame.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct FrameRecord {
    /// Its number in the recording.
    pub frame: u64,
    /// When it was exposed, s.
    pub exposed_at_s: f64,
    /// What happened to its pixels.
    pub mask: MaskShares,
    /// Median confidence of the filled pixels, 0–1; none were filled when absent.
    pub median_confidence: Option<f64>,
    /// Remaining misalignment with the light field, px; absent when it was not aligned.
    pub residual_alignment_px: Option<f64>,
    /// How far the picture moved the arm's pose, px at the scene.
    pub pose_correction_px: Option<f64>,
    /// Where its pose came from.
    pub pose: PoseOrigin,
    /// First frame after a scene cut.
    pub scene_cut: bool,
    /// Stages that passed it unaltered although they were in the line.
    pub bypassed: Vec<&'static str>,
}

impl FrameRecord {
    /// What the frame itself tells.
    pub fn of(frame: &Frame) -> Self {
        let mut mask = MaskShares {
            untouched: 1.0,
            ..MaskShares::default()
        };
        let mut median_confidence = None;
        if let Some(provenance) = &frame.provenance {
            let codes = provenance.code.pixels();
            let mut counts = [0_u64; 256];
            let mut confidences = [0_u64; 256];
            for (code, confidence) in codes.iter().zip(provenance.confidence.pixels()) {
                counts[usize::from(*code)] += 1;
                if *code >= provenance_code::RECENT {
                    confidences[usize::from(*confidence)] += 1;
                }
            }
            let share = |code: u8| counts[usize::from(code)] as f64 / codes.len().max(1) as f64;
            mask = MaskShares {
                untouched: share(provenance_code::UNTOUCHED),
                left: share(provenance_code::LEFT),
                recent: share(provenance_code::RECENT),
                made_up: share(provenance_code::MADE_UP),
                light_field: share(provenance_code::LIGHT_FIELD),
            };
            median_confidence = median_of(&confidences);
        }
        let aligned = frame.alignment.filter(|alignment| alignment.aligned);
        Self {
            frame: frame.id.0,
            exposed_at_s: frame.exposed_at.seconds(),
            mask,
            median_confidence,
            residual_alignment_px: aligned.map(|alignment| f64::from(alignment.region_shift_px)),
            pose_correction_px: aligned.map(|alignment| f64::from(alignment.correction_px)),
            pose: frame.pose_origin,
            scene_cut: frame.scene_cut,
            bypassed: frame
                .timings
                .iter()
                .filter(|timing| timing.bypassed)
                .map(|timing| timing.stage)
                .collect(),
        }
    }
}

/// The median of 0–255 by their counts, as 0–1.
fn median_of(counts: &[u64; 256]) -> Option<f64> {
    let total: u64 = counts.iter().sum();
    let mut below = 0;
    counts
        .iter()
        .position(|count| {
            below += count;
            total > 0 && 2 * below >= total
        })
        .map(|value| value as f64 / 255.0)
}

/// What a [`ReportSink`] has gathered.
#[derive(Clone, Debug, Default)]
pub struct Gathered {
    /// One for each frame, in order.
    pub frames: Vec<FrameRecord>,
    /// Explains the pixels of the last frame.
    pub camera: Option<Arc<CameraModel>>,
}

/// Gathers figures while the line runs.
#[derive(Debug, Default)]
pub struct ReportSink {
    gathered: Arc<Mutex<Gathered>>,
}

impl ReportSink {
    /// A sink, and where to read what it gathers.
    pub fn new() -> (Self, Arc<Mutex<Gathered>>) {
        let sink = Self::default();
        let gathered = Arc::clone(&sink.gathered);
        (sink, gathered)
    }
}

impl Sink for ReportSink {
    fn name(&self) -> &'static str {
        "report"
    }

    fn consume(&mut self, frame: &Arc<Frame>) -> Result<(), SinkError> {
        let record = FrameRecord::of(frame);
        let mut gathered = self.gathered.lock().unwrap_or_else(PoisonError::into_inner);
        gathered.frames.push(record);
        gathered.camera.clone_from(&frame.camera);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frame::{FrameId, Provenance};
    use crate::image::pool::Pool;
    use crate::time::Timestamp;

    #[test]
    fn shares_and_confidence_are_counted() {
        let mut frame = Frame::new(FrameId(7), Timestamp(0), Timestamp(0), Pool::new(1).take(10, 10));
        assert_eq!(
            FrameRecord::of(&frame).mask,
            MaskShares {
                untouched: 1.0,
                ..MaskShares::default()
            }
        );
        let (mut code, mut confidence) = (Pool::new(1).take(10, 10), Pool::new(1).take(10, 10));
        code.pixels_mut()[..20].fill(provenance_code::LEFT);
        code.pixels_mut()[20..50].fill(provenance_code::LIGHT_FIELD);
        confidence.pixels_mut()[20..40].fill(204);
        frame.provenance = Some(Provenance {
            code,
            view: Pool::new(1).take(10, 10),
            confidence,
        });
        let record = FrameRecord::of(&frame);
        assert_eq!(
            record.mask,
            MaskShares {
                untouched: 0.5,
                left: 0.2,
                light_field: 0.3,
                ..MaskShares::default()
            }
        );
        assert_eq!((record.median_confidence, record.frame), (Some(0.8), 7));
        let json = serde_json::to_value(&record).unwrap();
        assert_eq!(
            (json["mask"]["255"].as_f64(), json["pose"].as_str()),
            (Some(0.3), Some("missing"))
        );
    }
}
