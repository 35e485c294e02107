//! Straight lines straight: replaces the lens's picture by the pinhole's, and hands the frame its new camera.
//!
//! The endoscope's image field is respected: across its rim nothing is interpolated, so neither does black bleed into the tissue
//! nor tissue into the surround; and the surround stays as it came.

use std::ops::Range;
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use crate::camera::model::CameraModel;
use crate::camera::undistortion;
use crate::frame::Frame;
use crate::image::buffer::{Image, Mask, Rgb8};
use crate::image::remap::{Interpolation, RemapError, RemapTable};
use crate::pipeline::stage::{Stage, StageError};

/// How pictures are undistorted.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// nearest, bilinear or bicubic.
    pub interpolation: Interpolation,
    /// 0 = the output is just filled, 1 = nothing that the lens saw is lost; without it the output keeps the input's camera matrix.
    pub balance: Option<f64>,
}

/// Why pictures of this camera cannot be undistorted.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum UndistortionError {
    /// A setting out of its bounds.
    #[error("undistort.balance: expected a number from 0 to 1, found {0}")]
    Balance(f64),
    /// No pinhole shows the border of the picture.
    #[error(
        "undistort.balance: the border of the picture lies outside the lens's field; leave balance out to keep the camera matrix"
    )]
    Border,
    /// No table.
    #[error("the camera model cannot be turned into a table: {0}")]
    Table(#[from] RemapError),
}

/// Undistorts frames of one camera.
#[derive(Debug)]
pub struct Undistortion {
    table: RemapTable,
    interpolation: Interpolation,
    pinhole: Arc<CameraModel>,
    output: Image<Rgb8>,
    field: Option<FieldPatch>,
}

/// What the image field changes in a remapped picture; made once per field.
#[derive(Debug)]
struct FieldPatch {
    /// Of the input; told apart by address.
    input: Arc<Mask>,
    /// Of the output.
    output: Arc<Mask>,
    /// Output pixels at the rim, and the input pixel that each takes as it is.
    rim: Vec<(u32, u32)>,
    /// Output pixels outside both fields: they keep what stood there.
    kept: Vec<Range<usize>>,
    /// Output pixels outside the new field where the input had its field: black.
    black: Vec<Range<usize>>,
}

impl Undistortion {
    /// For frames of `camera`.
    pub fn new(settings: &Settings, camera: &CameraModel) -> Result<Self, UndistortionError> {
        let pinhole = match settings.balance {
            None => camera.pinhole(),
            Some(balance) if (0.0..=1.0).contains(&balance) => {
                undistortion::balanced_pinhole(camera, balance).ok_or(UndistortionError::Border)?
            }
            Some(other) => return Err(UndistortionError::Balance(other)),
        };
        let table = undistortion::table(camera, &pinhole)?;
        let output = Image::filled(pinhole.width, pinhole.height, [0; 3]);
        Ok(Self {
            table,
            interpolation: settings.interpolation,
            pinhole: Arc::new(pinhole),
            output,
            field: None,
        })
    }

    /// The camera that explains the output.
    pub fn pinhole(&self) -> &Arc<CameraModel> {
        &self.pinhole
    }
}

impl FieldPatch {
    fn new(table: &RemapTable, input: &Arc<Mask>) -> Result<Self, RemapError> {
        let (width, height) = table.size();
        let (source_width, source_height) = table.source_size();
        let mut output = Mask::filled(0, 0, 0);
        table.remap_mask(input, &mut output, Interpolation::Nearest)?;
        let (mut rim, mut kept, mut black) = (Vec::new(), Vec::new(), Vec::new());
        for y in 0..height {
            for x in 0..width {
                let index = y * width + x;
                if output.at(x, y) == 0 {
                    let was_outside = x < source_width && y < source_height && input.at(x, y) == 0;
                    extend_runs(if was_outside { &mut kept } else { &mut black }, index);
                    continue;
                }
                let Some((sx, sy)) = table.position(x, y) else { continue };
                let (left, top) = (sx.floor().max(0.0) as usize, sy.floor().max(0.0) as usize);
                let (right, bottom) = ((left + 1).min(source_width - 1), (top + 1).min(source_height - 1));
                let corners = [(left, top), (right, top), (left, bottom), (right, bottom)];
                if corners
                    .iter()
                    .any(|(cx, cy)| input.at((*cx).min(right), (*cy).min(bottom)) == 0)
                {
                    let near = |s: f64, last: usize| ((s + 0.5).floor().max(0.0) as usize).min(last);
                    rim.push((
                        index as u32,
                        (near(sy, source_height - 1) * source_width + near(sx, source_width - 1)) as u32,
                    ));
                }
            }
        }
        Ok(Self {
            input: Arc::clone(input),
            output: Arc::new(output),
            rim,
            kept,
            black,
        })
    }

    fn apply(&self, source: &Image<Rgb8>, out: &mut Image<Rgb8>) {
        let (from, to) = (source.pixels(), out.pixels_mut());
        for (pixel, origin) in &self.rim {
            to[*pixel as usize] = from[*origin as usize];
        }
        for run in &self.kept {
            // Runs are counted in the output; only with equal widths is that the input's count too.
            to[run.clone()].copy_from_slice(&from[run.clone()]);
        }
        for run in &self.black {
            to[run.clone()].fill([0; 3]);
        }
    }
}

fn extend_runs(runs: &mut Vec<Range<usize>>, index: usize) {
    match runs.last_mut() {
        Some(last) if last.end == index => last.end += 1,
        _ => runs.push(index..index + 1),
    }
}

impl Stage for Undistortion {
    fn name(&self) -> &'static str {
        "undistort"
    }

    fn process(&mut self, frame: &mut Frame) -> Result<(), StageError> {
        let fail = |e: RemapError| StageError(format!("undistortion: {e}"));
        self.table
            .remap_rgb(&frame.image, &mut self.output, self.interpolation)
            .map_err(fail)?;
        match &frame.field_of_view {
            Some(field) if field.size() == frame.image.size() => {
                if !self.field.as_ref().is_some_and(|patch| Arc::ptr_eq(&patch.input, field)) {
                    self.field = Some(FieldPatch::new(&self.table, field).map_err(fail)?);
                }
            }
            _ => self.field = None,
        }
        if let Some(patch) = &self.field {
            patch.apply(&frame.image, &mut self.output);
            frame.field_of_view = Some(Arc::clone(&patch.output));
        }
        frame.camera = Some(Arc::clone(&self.pinhole));
        frame.image.swap(&mut self.output);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::distortion::Distortion;
    use crate::camera::intrinsics::Intrinsics;
    use crate::frame::FrameId;
    use crate::image::pool::Pool;
    use crate::time::Timestamp;

    fn camera() -> CameraModel {
        let intrinsics = Intrinsics {
            fx: 110.0,
            fy: 110.0,
            cx: 79.5,
            cy: 59.5,
        };
        CameraModel {
            width: 160,
            height: 120,
            intrinsics,
            distortion: Distortion::BrownConrady {
                k: [-0.3, 0.06, 0.0, 0.0, 0.0, 0.0],
                p: [0.0; 2],
            },
        }
    }

    fn frame(image: &Image<Rgb8>, field: Option<Arc<Mask>>) -> Frame {
        let mut frame = Frame::new(FrameId(0), Timestamp(0), Timestamp(0), Pool::new(2).take_copy(image));
        frame.field_of_view = field;
        frame
    }

    #[test]
    fn the_frame_gets_a_pinhole_and_keeps_its_original() {
        let image = Image::filled(160, 120, [9, 8, 7]);
        let mut stage = Undistortion::new(&Settings::default(), &camera()).unwrap();
        let mut frame = frame(&image, None);
        frame.original = Some(Pool::new(1).take_copy(&image));
        stage.process(&mut frame).unwrap();
        assert_eq!(frame.camera.as_deref(), Some(&camera().pinhole()));
        assert_eq!(frame.original.as_deref(), Some(&image));
        assert_eq!(frame.image.at(80, 60), [9, 8, 7]);
    }

    #[test]
    fn another_size_leaves_the_frame_as_it_came() {
        let image = Image::filled(80, 60, [1; 3]);
        let mut stage = Undistortion::new(&Settings::default(), &camera()).unwrap();
        let mut frame = frame(&image, None);
        assert!(stage.process(&mut frame).unwrap_err().0.contains("(160, 120)"));
        assert_eq!(*frame.image, image);
        assert!(frame.camera.is_none());
    }

    #[test]
    fn nothing_bleeds_across_the_rim() {
        let inside = |x: usize, y: usize| (x as f64 - 79.5).hypot(y as f64 - 59.5) < 45.0;
        let mut image = Image::filled(160, 120, [3, 3, 3]);
        let mut mask = Mask::filled(160, 120, 0);
        for y in 0..120 {
            for x in 0..160 {
                if inside(x, y) {
                    image.set(x, y, [200, 100, 90]);
                    mask.set(x, y, 255);
                }
            }
        }
        let mut stage = Undistortion::new(&Settings::default(), &camera()).unwrap();
        let mut frame = frame(&image, Some(Arc::new(mask.clone())));
        stage.process(&mut frame).unwrap();
        let field = frame.field_of_view.clone().unwrap();
        for y in 0..120 {
            for x in 0..160 {
                let pixel = frame.image.at(x, y);
                if field.at(x, y) == 255 {
                    assert_eq!(pixel, [200, 100, 90], "({x}, {y})");
                } else if mask.at(x, y) == 0 {
                    assert_eq!(pixel, [3, 3, 3], "({x}, {y})");
                } else {
                    assert_eq!(pixel, [0, 0, 0], "({x}, {y})");
                }
            }
        }
        // A barrel's field grows when it is straightened.
        assert!(field.pixels().iter().filter(|v| **v > 0).count() > mask.pixels().iter().filter(|v| **v > 0).count());
    }

    #[test]
    fn settings_are_checked() {
        let settings = |balance| Settings {
            balance: Some(balance),
            ..Settings::default()
        };
        assert!(matches!(
            Undistortion::new(&settings(1.5), &camera()),
            Err(UndistortionError::Balance(_))
        ));
        assert!(matches!(
            Undistortion::new(&settings(f64::NAN), &camera()),
            Err(UndistortionError::Balance(_))
        ));
        assert!(Undistortion::new(&settings(0.5), &camera()).is_ok());
    }
}
