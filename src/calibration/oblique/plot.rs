//! A picture of a calibration of an oblique scope: left the residual vectors on the sensor and what the picture turns about, right how
//! well each picture fits, by rotations.

use crate::calibration::oblique::refine::Calibration;
use crate::calibration::oblique::report::Report;
use crate::calibration::plot::bars::Bars;
use crate::calibration::plot::field::Field;
use crate::calibration::plot::style::{BACKGROUND, CAPTION, GRID, LEFT_OUT, MARGIN, PANEL_WIDTH, WHITE};
use crate::camera::intrinsics::Pixel;
use crate::image::buffer::{Image, Rgb8};
use crate::image::canvas::{Canvas, heat};

/// Pictures that fit worse than this many times the whole are of the color of what is left out.
const MUCH_WORSE: f64 = 4.0;

/// Draw it.
pub fn drawn(calibration: &Calibration, report: &Report) -> Image<Rgb8> {
    let camera = &calibration.camera;
    let (left, right, top) = (MARGIN as f64, (2 * MARGIN + PANEL_WIDTH) as f64, (MARGIN + CAPTION) as f64);
    let field = Field::new([left, top], (camera.width, camera.height));
    let mut canvas = Canvas::new(2 * PANEL_WIDTH + 3 * MARGIN, field.height + CAPTION + 2 * MARGIN, BACKGROUND);
    field.ground(&mut canvas);
    field.grid(&mut canvas);
    let magnification = field.arrows(&mut canvas, calibration.residuals.iter().flatten());
    let [x, y] = report.center_px;
    let [x, y] = field.at(Pixel { x, y });
    canvas.line([x - 14.0, y], [x + 14.0, y], WHITE);
    canvas.line([x, y - 14.0], [x, y + 14.0], WHITE);
    let words = format!("RESIDUALS X{magnification:.0}  RMS {:.3} PX  + TURNS HERE", report.rms_px);
    canvas.text(MARGIN, MARGIN, &words, WHITE);

    let bars = Bars {
        corner: [right, top],
        height: field.height,
        first: 0.001,
        decades: 4,
        unit: "px",
        places: report.pictures.len(),
    };
    bars.ground(&mut canvas);
    let mut place = 0;
    for (number, rotation) in report.rotations.iter().enumerate() {
        let from = bars.left_of(place);
        canvas.line([from, top], [from, top + field.height as f64], GRID);
        for picture in report.pictures.iter().filter(|picture| picture.rotation == rotation.name) {
            let worse = picture.rms_px / (MUCH_WORSE * report.rms_px);
            let color = if worse > 1.0 || picture.corners_used == 0 {
                LEFT_OUT
            } else {
                heat(worse)
            };
            bars.bar(&mut canvas, place, [0.1, 0.9], picture.rms_px, color);
            place += 1;
        }
        // Of many narrow rotations the words would lie on each other: on two lines they have twice the room.
        let line = top as usize + 6 + 26 * (number % 2);
        canvas.text(from as usize + 6, line, &format!("{:.1}", rotation.angle_deg), WHITE);
    }
    bars.numbers(&mut canvas);
    canvas.text(right as usize, MARGIN, "RMS OF PICTURES, BY ROTATION (DEGREES)", WHITE);
    canvas.image
}

#[cfg(test)]
mod tests {
    use nalgebra::{DMatrix, Unit, Vector3};

    use super::*;
    use crate::calibration::board::detection::BoardCorner;
    use crate::calibration::camera::lens::LensModel;
    use crate::calibration::camera::refine::Residual;
    use crate::calibration::oblique::joint::Sighting;
    use crate::calibration::oblique::report::Names;
    use crate::camera::distortion::Distortion;
    use crate::camera::intrinsics::Intrinsics;
    use crate::camera::model::CameraModel;
    use crate::camera::oblique::Oblique;
    use crate::geometry::point::Point;

    /// Three pictures at two rotations; their residuals are as given.
    fn picture(residuals: Vec<Residual>, sighting_rms_px: Vec<f64>) -> Image<Rgb8> {
        let calibration = Calibration {
            camera: CameraModel {
                width: 640,
                height: 480,
                intrinsics: Intrinsics {
                    fx: 500.0,
                    fy: 500.0,
                    cx: 320.0,
                    cy: 240.0,
                },
                distortion: Distortion::None,
            },
            model: LensModel::PlumbBob,
            oblique: Oblique {
                axis: Unit::new_normalize(Vector3::new(0.0, 0.5, 1.0)),
                point_mm: Vector3::zeros(),
                center: Pixel { x: 320.0, y: 240.0 },
            },
            angles_rad: vec![0.0, 0.5],
            covariance: DMatrix::identity(16, 16),
            camera_from_board: Vec::new(),
            rms_px: 0.1,
            sighting_rms_px,
            residuals: vec![residuals, vec![residual(true, [0.1, 0.0])], vec![residual(true, [0.0, 0.1])]],
            used: [1, 2],
            fixed_rms_px: 50.0,
        };
        let sighting = |station, rotation| Sighting {
            station,
            rotation,
            corners: Vec::new(),
        };
        let names = Names {
            rotations: ["start", "left"].map(str::to_owned).to_vec(),
            stations: ["a", "b"].map(str::to_owned).to_vec(),
            pictures: ["1", "2", "3"].map(str::to_owned).to_vec(),
        };
        let sightings = [sighting(0, 0), sighting(0, 1), sighting(1, 0)];
        let report = Report::new(&calibration, &sightings, &[None, None], &names, Vec::new());
        drawn(&calibration, &report)
    }

    fn residual(used: bool, error_px: [f64; 2]) -> Residual {
        Residual {
            corner: BoardCorner {
                site: 0,
                board: Point::new(0.0, 0.0, 0.0),
                pixel: Pixel { x: 100.0, y: 100.0 },
                sigma_px: 0.1,
            },
            error_px,
            used,
        }
    }

    #[test]
    fn a_picture_that_fits_badly_and_a_corner_left_out_stand_out() {
        let good = vec![0.1, 0.12, 0.09];
        let fits = residual(true, [0.1, 0.0]);
        let marked = |image: Image<Rgb8>| image.pixels().iter().filter(|pixel| **pixel == LEFT_OUT).count();
        assert_eq!(marked(picture(vec![fits], good.clone())), 0);
        // A cross of two strokes of nine pixels, some of them the same when rounded.
        let cross = marked(picture(vec![fits, residual(false, [9.0, 0.0])], good.clone()));
        assert!((9..=18).contains(&cross), "{cross}");
        // A picture of which nothing was used has its bar in that color too.
        assert!(marked(picture(vec![residual(false, [9.0, 0.0])], good)) > 200 * 400);
        // A third of the panel, less the gaps, to a place above two thirds of it.
        let bar = marked(picture(vec![fits], vec![0.1, 2.5, 0.1]));
        assert!(bar > 200 * 400, "{bar}");
    }

    #[test]
    fn strange_numbers_are_drawn_somewhere_or_not_at_all() {
        let strange = vec![residual(true, [f64::NAN, 0.0]), residual(true, [f64::INFINITY, 1.0])];
        assert!(picture(strange, vec![f64::NAN, f64::INFINITY, 0.0]).height() > 0);
    }
}
