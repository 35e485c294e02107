//! Measures frames against a simulation's truth while they leave the line, and shows the most telling one.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use anyhow::Context as _;

use crate::camera::model::CameraModel;
use crate::frame::{Frame, provenance_code};
use crate::image::buffer::{Image, Mask, Rgb8};
use crate::image::pool::Pool;
use crate::pipeline::stage::{Sink, SinkError, Stage as _};
use crate::quality::figures::{Figures, OutputFrame, TruthFrame};
use crate::stages::undistortion::{self, Undistortion};

/// Half the size of the picture's crops, px.
const CROP: (usize, usize) = (120, 90);
/// Each pixel is shown this large.
const ENLARGED: usize = 3;
/// Between the crops, px.
const DIVIDER: usize = 6;

/// What was measured.
#[derive(Debug, Default)]
pub struct Measured {
    /// The figures of quality.
    pub figures: Figures,
    telling: Option<Telling>,
}

/// The frame with the most specular pixels.
#[derive(Debug)]
struct Telling {
    specular_pixels: usize,
    specular: Mask,
    before: Image<Rgb8>,
    after: Image<Rgb8>,
    truth: Image<Rgb8>,
}

/// Compares each frame with the truth of the same number.
#[derive(Debug)]
pub struct MeasureSink {
    truth: PathBuf,
    undistortion: Undistortion,
    pool: Pool<Rgb8>,
    untouched: Mask,
    measured: Arc<Mutex<Measured>>,
}

impl MeasureSink {
    /// `truth` holds `diffuse`, `specular`, `strength` and `instrument`, pinhole pictures numbered as the recording; `camera` is
    /// the recording's own.
    pub fn new(
        truth: &Path,
        camera: &CameraModel,
        settings: &undistortion::Settings,
        measured: Arc<Mutex<Measured>>,
    ) -> anyhow::Result<Self> {
        Ok(Self {
            truth: truth.to_owned(),
            undistortion: Undistortion::new(settings, camera)?,
            pool: Pool::new(2),
            untouched: Mask::filled(camera.width, camera.height, provenance_code::UNTOUCHED),
            measured,
        })
    }

    fn compare(&mut self, frame: &Frame) -> anyhow::Result<()> {
        let name = format!("{:06}.png", frame.id.0);
        let picture = |kind: &str| read_rgb(&self.truth.join(kind).join(&name));
        let mask = |kind: &str| read_mask(&self.truth.join(kind).join(&name));
        let (diffuse, specular, strength, instruments) =
            (picture("diffuse")?, mask("specular")?, mask("strength")?, mask("instrument")?);
        let original = frame
            .original
            .as_ref()
            .context("expected the line to keep each picture as it came, found none")?;
        let mut input = Frame::new(frame.id, frame.exposed_at, frame.arrived_at, self.pool.take_copy(original));
        self.undistortion.process(&mut input)?;
        let truth = TruthFrame {
            diffuse: &diffuse,
            specular: &specular,
            strength: &strength,
            instruments: Some(&instruments),
        };
        let code = frame
            .provenance
            .as_ref()
            .map_or(&self.untouched, |provenance| &*provenance.code);
        let mut measured = self.measured.lock().unwrap_or_else(PoisonError::into_inner);
        measured.figures.add(
            &truth,
            &OutputFrame {
                image: &frame.image,
                mask: code,
                input: &input.image,
            },
        )?;
        let specular_pixels = specular.pixels().iter().filter(|value| **value > 0).count();
        if measured
            .telling
            .as_ref()
            .is_none_or(|best| best.specular_pixels < specular_pixels)
        {
            measured.telling = Some(Telling {
                specular_pixels,
                specular,
                before: input.image.clone(),
                after: frame.image.clone(),
                truth: diffuse,
            });
        }
        Ok(())
    }
}

impl Sink for MeasureSink {
    fn name(&self) -> &'static str {
        "measure"
    }

    fn consume(&mut self, frame: &Arc<Frame>) -> Result<(), SinkError> {
        self.compare(frame).map_err(|error| SinkError(format!("{error:#}")))
    }
}

fn opened(path: &Path) -> anyhow::Result<image::DynamicImage> {
    image::open(path).with_context(|| format!("reading the truth {}", path.display()))
}

fn read_rgb(path: &Path) -> anyhow::Result<Image<Rgb8>> {
    let picture = opened(path)?.into_rgb8();
    let (width, height) = (picture.width() as usize, picture.height() as usize);
    let pixels = picture.pixels().map(|pixel| pixel.0).collect();
    Image::from_vec(width, height, pixels).context("a picture has as many pixels as its size says")
}

fn read_mask(path: &Path) -> anyhow::Result<Mask> {
    let picture = opened(path)?.into_luma8();
    let (width, height) = (picture.width() as usize, picture.height() as usize);
    Image::from_vec(width, height, picture.into_raw()).context("a picture has as many pixels as its size says")
}

/// Crops of the frame with the most specular pixels, where most of them are: before | after | truth.
pub fn before_after(measured: &Measured) -> Option<Image<Rgb8>> {
    let telling = measured.telling.as_ref()?;
    let (width, height) = telling.specular.size();
    let (crop_width, crop_height) = ((2 * CROP.0).min(width), (2 * CROP.1).min(height));
    let (left, top) = densest_window(&telling.specular, crop_width, crop_height);
    let parts = [&telling.before, &telling.after, &telling.truth];
    let (shown_width, shown_height) = (crop_width * ENLARGED, crop_height * ENLARGED);
    let mut out = Image::filled(3 * shown_width + 2 * DIVIDER, shown_height, [255; 3]);
    for (index, part) in parts.into_iter().enumerate() {
        let start = index * (shown_width + DIVIDER);
        for y in 0..shown_height {
            let source = part.row(top + y / ENLARGED);
            let row = &mut out.row_mut(y)[start..start + shown_width];
            for (x, pixel) in row.iter_mut().enumerate() {
                *pixel = source[left + x / ENLARGED];
            }
        }
    }
    Some(out)
}

/// Top-left corner of the window with the most pixels set, on a grid of 8 px.
fn densest_window(mask: &Mask, width: usize, height: usize) -> (usize, usize) {
    const STEP: usize = 8;
    let count = |left: usize, top: usize| -> usize {
        (top..top + height)
            .step_by(2)
            .map(|y| mask.row(y)[left..left + width].iter().filter(|value| **value > 0).count())
            .sum()
    };
    let places = (0..=mask.height() - height)
        .step_by(STEP)
        .flat_map(|top| (0..=mask.width() - width).step_by(STEP).map(move |left| (left, top)));
    places.max_by_key(|(left, top)| count(*left, *top)).unwrap_or((0, 0))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_window_goes_where_most_is() {
        let mut mask = Mask::filled(640, 360, 0);
        for y in 200..240 {
            mask.row_mut(y)[400..460].fill(255);
        }
        let (left, top) = densest_window(&mask, 240, 180);
        assert!(
            left <= 400 && left + 240 >= 460 && top <= 200 && top + 180 >= 240,
            "{left} {top}"
        );
    }

    #[test]
    fn the_three_crops_stand_side_by_side() {
        let telling = Telling {
            specular_pixels: 1,
            specular: Mask::filled(300, 200, 0),
            before: Image::filled(300, 200, [1; 3]),
            after: Image::filled(300, 200, [2; 3]),
            truth: Image::filled(300, 200, [3; 3]),
        };
        let picture = before_after(&Measured {
            telling: Some(telling),
            ..Measured::default()
        })
        .unwrap();
        assert_eq!(picture.size(), (3 * 720 + 12, 540));
        let third = picture.width() / 3;
        assert_eq!(
            [picture.at(5, 5), picture.at(third + 60, 5), picture.at(2 * third + 60, 5)],
            [[1; 3], [2; 3], [3; 3]]
        );
    }
}
