//! Color normalization as a stage of the line.

use rayon::iter::{IndexedParallelIterator as _, ParallelIterator as _};
use rayon::slice::{ParallelSlice as _, ParallelSliceMut as _};

use crate::frame::Frame;
use crate::image::buffer::{Image, Rgb8};
use crate::image::color_correction::Correction;
use crate::image::wide;
use crate::pipeline::stage::{Stage, StageError};
use crate::stages::color_normalization::affine::{Affine, AffineRun, BLACK_LEVEL};
use crate::stages::color_normalization::clahe::Clahe;
use crate::stages::color_normalization::color_file::{ColorFile, Reference};
use crate::stages::color_normalization::cube_lut::{BakedLut, CubeError, CubeLut, LutRun};
use crate::stages::color_normalization::matching::{affine_between, gray_of};
use crate::stages::color_normalization::settings::{Method, ReferenceSource, Settings, SettingsError};
use crate::stages::color_normalization::statistics::{self, Measurement, Statistics};

/// Rows a thread takes at a time.
const BAND_ROWS: usize = 16;
/// A map that moves no color by as much as this many levels is not worth a pass.
const NEGLIGIBLE_LEVELS: f32 = 0.25;
/// How often the first frame is measured again by the tint it showed.
const SETTLING_ROUNDS: usize = 4;
/// What a frame lasts when nobody tells, ms.
const TYPICAL_PERIOD_MS: f64 = 40.0;

/// Why the stage cannot be built.
#[derive(Debug, thiserror::Error)]
pub enum ColorError {
    /// A setting.
    #[error(transparent)]
    Settings(#[from] SettingsError),
    /// The `.cube` file.
    #[error(transparent)]
    Cube(#[from] CubeError),
}

/// Brings the tissue's colors to the reference.
#[derive(Debug)]
pub struct ColorNormalization {
    settings: Settings,
    correction: Option<Correction>,
    lut: Option<CubeLut>,
    reference: Option<Reference>,
    /// Sum of the clip's first statistics, their number, and the time they cover, ms.
    start: Option<(Statistics, f64, f64)>,
    map: Affine,
    /// The channel gains that bring the mean to the reference's: what a sample is judged by. The map itself would not do:
    /// steel among the samples bends it, and the bent map would let in more steel.
    gains: Affine,
    measured: u32,
    baked: BakedLut,
    baked_for: Option<Affine>,
    clahe: Clahe,
    output: Image<Rgb8>,
}

impl ColorNormalization {
    /// With checked settings and the instrument's `color.yaml`, if there is one.
    pub fn new(settings: &Settings, color_file: Option<&ColorFile>) -> Result<Self, ColorError> {
        settings.check()?;
        let lut = settings.lut.as_deref().map(CubeLut::read).transpose()?;
        let given = settings
            .reference_statistics()
            .map(|(mean, covariance)| Reference { mean, covariance })
            .or_else(|| color_file.and_then(|file| file.reference));
        Ok(Self {
            settings: settings.clone(),
            correction: color_file.and_then(|file| file.correction.clone()),
            lut,
            reference: given.filter(|_| settings.reference == ReferenceSource::Given),
            start: None,
            map: Affine::IDENTITY,
            gains: Affine::IDENTITY,
            measured: 0,
            baked: BakedLut::default(),
            baked_for: None,
            clahe: Clahe::default(),
            output: Image::filled(0, 0, [0; 3]),
        })
    }

    /// Why this stage would leave every frame alone, if it would: a line for the user.
    pub fn idle_reason(&self) -> Option<&'static str> {
        if self.matches() || self.correction.is_some() || self.lut.is_some() || self.settings.equalization > 0.0 {
            None
        } else if self.settings.method == Method::None || self.settings.strength == 0.0 {
            Some("color normalization is switched off (method = none or strength = 0) and nothing else is asked for")
        } else {
            Some(
                "no color.yaml beside the recording and no reference set: colors are left as they are (color.reference = \"start\" holds the clip's own)",
            )
        }
    }

    /// The map in force.
    pub fn map(&self) -> &Affine {
        &self.map
    }

    fn matches(&self) -> bool {
        self.settings.method != Method::None
            && self.settings.strength > 0.0
            && (self.reference.is_some() || self.settings.reference != ReferenceSource::Given)
    }

    fn update_map(&mut self, frame: &Frame, step_ms: f64) {
        if frame.scene_cut {
            return;
        }
        let mut found = self.measure(frame);
        if self.measured == 0 {
            // Nothing is known yet about the tint by which samples are judged: settle it on this frame.
            for _ in 0..SETTLING_ROUNDS {
                let Some(now) = found.statistics else { return };
                self.gains = self.target_gains(&now).unwrap_or(Affine::IDENTITY);
                found = self.measure(frame);
            }
        }
        let Some(now) = found.statistics else { return };
        if found.instrument_share > self.settings.max_instrument_share {
            return;
        }
        self.take_start(&now, step_ms);
        let (Some(target), Some(gains)) = (self.target(&now), self.target_gains(&now)) else {
            return;
        };
        self.measured = self.measured.saturating_add(1);
        let steady = if self.settings.smoothing_ms > 0.0 {
            1.0 - (-step_ms / self.settings.smoothing_ms).exp()
        } else {
            1.0
        };
        // The first measurements count equally, so that the map is there at once and does not swing in.
        let alpha = steady.max(1.0 / f64::from(self.measured));
        self.map.approach(&target, alpha as f32);
        self.gains.approach(&gains, alpha as f32);
    }

    fn measure(&self, frame: &Frame) -> Measurement {
        let field_of_view = frame.field_of_view.as_deref();
        let judged = |c| self.gains.apply(c);
        match &self.correction {
            Some(correction) => statistics::measure(&frame.image, field_of_view, |c| correction.apply(c), judged),
            None => statistics::measure(&frame.image, field_of_view, |c| c, judged),
        }
    }

    /// While the clip's own start is to be the reference: add a frame to it.
    fn take_start(&mut self, now: &Statistics, step_ms: f64) {
        if self.reference.is_some() || self.settings.reference != ReferenceSource::Start {
            return;
        }
        let zero = Statistics {
            mean: nalgebra::Vector3::zeros(),
            covariance: nalgebra::Matrix3::zeros(),
        };
        let (sum, count, covered_ms) = self.start.get_or_insert((zero, 0.0, 0.0));
        sum.mean += now.mean;
        sum.covariance += now.covariance;
        *count += 1.0;
        *covered_ms += step_ms;
        if *covered_ms >= self.settings.start_ms {
            self.reference = Some(Reference {
                mean: sum.mean / *count,
                covariance: Some(sum.covariance / *count),
            });
            // The map starts from the identity and from here on changes only as fast as the smoothing allows.
            self.measured = u32::MAX;
        }
    }

    /// The gains these statistics ask for; `None` while there is no reference.
    fn target_gains(&self, now: &Statistics) -> Option<Affine> {
        let to = match self.settings.reference {
            ReferenceSource::Gray => return Some(Affine::IDENTITY),
            _ => Statistics {
                mean: self.reference.as_ref()?.mean,
                covariance: now.covariance,
            },
        };
        Some(affine_between(now, &to, Method::GrayWorld, 1.0))
    }

    /// The map these statistics ask for; `None` while there is no reference.
    fn target(&self, now: &Statistics) -> Option<Affine> {
        let strength = self.settings.strength;
        if self.settings.reference == ReferenceSource::Gray {
            return Some(affine_between(now, &gray_of(now), Method::GrayWorld, strength));
        }
        let reference = self.reference.as_ref()?;
        Some(match reference.covariance {
            Some(covariance) => {
                let to = Statistics {
                    mean: reference.mean,
                    covariance,
                };
                affine_between(now, &to, self.settings.method, strength)
            }
            // A mean alone tells gains and nothing about the cluster's shape.
            None => {
                let to = Statistics {
                    mean: reference.mean,
                    covariance: now.covariance,
                };
                affine_between(now, &to, Method::GrayWorld, strength)
            }
        })
    }

    /// Chain of correction, map and table into `output`; false if there is nothing to do.
    fn render(&mut self, frame: &Frame) -> bool {
        let (width, height) = frame.image.size();
        let needs_table = self.correction.is_some() || self.lut.is_some();
        if !needs_table && self.map.largest_change() < NEGLIGIBLE_LEVELS {
            return false;
        }
        if self.output.size() != (width, height) {
            self.output.resize(width, height, [0; 3]);
        }
        if needs_table {
            self.bake();
        }
        let field_of_view: &[u8] = frame
            .field_of_view
            .as_ref()
            .filter(|mask| mask.size() == (width, height))
            .map_or(&[], |mask| mask.pixels());
        let band = BAND_ROWS * width;
        let (map, baked) = (self.map, &self.baked);
        self.output
            .pixels_mut()
            .par_chunks_mut(band)
            .zip(frame.image.pixels().par_chunks(band))
            .enumerate()
            .for_each(|(index, (target, source))| {
                let start = (index * band).min(field_of_view.len());
                let field_of_view = &field_of_view[start..(start + source.len()).min(field_of_view.len())];
                if needs_table {
                    let black_level = BLACK_LEVEL as u8;
                    wide::run(LutRun {
                        lut: baked,
                        source,
                        target,
                        field_of_view,
                        black_level,
                    });
                } else {
                    wide::run(AffineRun {
                        map,
                        source,
                        target,
                        field_of_view,
                    });
                }
            });
        true
    }

    fn bake(&mut self) {
        if self.baked_for == Some(self.map) {
            return;
        }
        let (map, correction, lut) = (self.map, self.correction.as_ref(), self.lut.as_ref());
        self.baked.bake(|color| {
            let corrected = correction.map_or(color, |correction| correction.apply(color));
            let mapped = map.apply_blended(corrected).map(|v| v.clamp(0.0, 255.0));
            lut.map_or(mapped, |lut| lut.apply(mapped))
        });
        self.baked_for = Some(map);
    }
}

impl Stage for ColorNormalization {
    fn name(&self) -> &'static str {
        "color_normalization"
    }

    fn process(&mut self, frame: &mut Frame) -> Result<(), StageError> {
        let (width, height) = frame.image.size();
        if width == 0 || height == 0 {
            return Err(StageError(
                "expected a picture, found one without pixels; check the source".to_owned(),
            ));
        }
        let step_ms = match frame.since_previous.milliseconds() {
            step if step > 0.0 => step.min(10.0 * TYPICAL_PERIOD_MS),
            _ => TYPICAL_PERIOD_MS,
        };
        if self.matches() {
            self.update_map(frame, step_ms);
        }
        let changed = self.render(frame);
        if self.settings.equalization > 0.0 {
            if !changed {
                self.output.copy_from(&frame.image);
            }
            let field_of_view = frame.field_of_view.as_deref();
            let alpha = 1.0 - (-step_ms / self.settings.smoothing_ms.max(1.0)).exp();
            self.clahe.learn(&self.output, field_of_view, alpha as f32);
            self.clahe
                .apply(&mut self.output, field_of_view, self.settings.equalization as f32);
        }
        if changed || self.settings.equalization > 0.0 {
            frame.image.swap(&mut self.output);
        }
        Ok(())
    }

    /// The map is the camera's and outlives a gap; only what belongs to the scene is forgotten.
    fn reset(&mut self) {
        self.clahe.clear();
    }
}
