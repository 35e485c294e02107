//! What the calibration of an oblique scope tells its user: a table for people, JSON for machines.

use std::fmt::Write as _;

use serde::Serialize;

use crate::calibration::camera::lens;
use crate::calibration::oblique::joint::Sighting;
use crate::calibration::oblique::refine::Calibration;

/// An angle known worse than this is worth a warning, rad.
const UNSURE_ANGLE: f64 = 0.01;

/// A number and its deviation.
#[derive(Clone, Debug, Serialize)]
pub struct Number {
    /// fx, axis, …
    pub name: String,
    /// As estimated.
    pub value: f64,
    /// Standard deviation.
    pub sigma: f64,
}

/// A rotation of the telescope.
#[derive(Clone, Debug, Serialize)]
pub struct RotationReport {
    /// As the user names it.
    pub name: String,
    /// As estimated; the first one's is held.
    pub angle_deg: f64,
    /// Standard deviation; 0 for the first.
    pub sigma_deg: f64,
    /// As told.
    pub given_deg: Option<f64>,
}

/// A picture.
#[derive(Clone, Debug, Serialize)]
pub struct PictureReport {
    /// File.
    pub name: String,
    /// As the user names it.
    pub station: String,
    /// As the user names it.
    pub rotation: String,
    /// Corners found.
    pub corners: usize,
    /// Those of them that were used: the others are too far off.
    pub corners_used: usize,
    /// Over residual vectors of the corners used, or of all where none was, px.
    pub rms_px: f64,
}

/// Names that the user gave.
#[derive(Clone, Debug)]
pub struct Names {
    /// Of the rotations.
    pub rotations: Vec<String>,
    /// Of the stations.
    pub stations: Vec<String>,
    /// Of the pictures, in the order of the sightings.
    pub pictures: Vec<String>,
}

/// All that is told.
#[derive(Clone, Debug, Serialize)]
pub struct Report {
    /// Version of the program.
    pub version: &'static str,
    /// How far aside the telescope looks, degrees.
    pub obliqueness_deg: f64,
    /// Its standard deviation.
    pub obliqueness_sigma_deg: f64,
    /// Direction of the telescope's axis in the camera's space at angle 0.
    pub axis: [f64; 3],
    /// Standard deviations of its turn about two directions across it, degrees.
    pub axis_sigma_deg: [f64; 2],
    /// Nearest point of the axis, mm.
    pub point_mm: [f64; 3],
    /// Standard deviations across the axis, mm.
    pub point_sigma_mm: [f64; 2],
    /// What the picture turns about, px.
    pub center_px: [f64; 2],
    /// Standard deviations, px.
    pub center_sigma_px: [f64; 2],
    /// The camera at angle 0.
    pub parameters: Vec<Number>,
    /// Angles.
    pub rotations: Vec<RotationReport>,
    /// Of the parameters, axis (rad), point (mm), centre (px), angles but the first (rad).
    pub covariance: Vec<Vec<f64>>,
    /// Over residual vectors of the corners used, px.
    pub rms_px: f64,
    /// The same if turning were ignored.
    pub rms_without_turning_px: f64,
    /// Corners used, of all.
    pub corners_used: [usize; 2],
    /// Pictures with a board.
    pub pictures: Vec<PictureReport>,
    /// Pictures without, and why.
    pub without_board: Vec<String>,
    /// What to mend.
    pub warnings: Vec<String>,
}

impl Report {
    /// Of a calibration.
    pub fn new(
        calibration: &Calibration,
        sightings: &[Sighting],
        given_rad: &[Option<f64>],
        names: &Names,
        without_board: Vec<String>,
    ) -> Self {
        let joint = calibration.first_joint_place();
        let sigma = |place: usize| calibration.sigma(joint + place);
        let oblique = &calibration.oblique;
        let name = |names: &[String], place: usize| names.get(place).cloned().unwrap_or_default();
        let rotations: Vec<RotationReport> = (calibration.angles_rad.iter().enumerate())
            .map(|(rotation, angle)| RotationReport {
                name: name(&names.rotations, rotation),
                angle_deg: angle.to_degrees(),
                sigma_deg: if rotation == 0 {
                    0.0
                } else {
                    sigma(5 + rotation).to_degrees()
                },
                given_deg: given_rad.get(rotation).copied().flatten().map(f64::to_degrees),
            })
            .collect();
        let unsure: Vec<&str> = (rotations.iter())
            .filter(|rotation| rotation.sigma_deg.to_radians() > UNSURE_ANGLE)
            .map(|rotation| rotation.name.as_str())
            .collect();
        let mut warnings = Vec::new();
        if !unsure.is_empty() {
            warnings.push(format!("angles known badly: {}; add stations there", unsure.join(", ")));
        }
        let pictures: Vec<PictureReport> = (sightings.iter().enumerate())
            .map(|(place, sighting)| {
                let residuals = calibration.residuals.get(place).map_or(&[][..], Vec::as_slice);
                let corners_used = residuals.iter().filter(|residual| residual.used).count();
                let rms_px = if corners_used == 0 && !residuals.is_empty() {
                    let squares = residuals.iter().map(|r| r.error_px[0].powi(2) + r.error_px[1].powi(2));
                    (squares.sum::<f64>() / residuals.len() as f64).sqrt()
                } else {
                    calibration.sighting_rms_px.get(place).copied().unwrap_or(f64::NAN)
                };
                PictureReport {
                    name: name(&names.pictures, place),
                    station: name(&names.stations, sighting.station),
                    rotation: name(&names.rotations, sighting.rotation),
                    corners: sighting.corners.len(),
                    corners_used,
                    rms_px,
                }
            })
            .collect();
        for picture in pictures.iter().filter(|picture| picture.corners_used == 0) {
            warnings.push(format!(
                "{} fits nothing else and was left out ({:.2} px off): did head, board or telescope move there?",
                picture.name, picture.rms_px
            ));
        }
        Self {
            version: env!("CARGO_PKG_VERSION"),
            obliqueness_deg: oblique.obliqueness_rad().to_degrees(),
            obliqueness_sigma_deg: sigma(0).hypot(sigma(1)).to_degrees() / std::f64::consts::SQRT_2,
            axis: oblique.axis.into_inner().into(),
            axis_sigma_deg: [sigma(0).to_degrees(), sigma(1).to_degrees()],
            point_mm: oblique.point_mm.into(),
            point_sigma_mm: [sigma(2), sigma(3)],
            center_px: [oblique.center.x, oblique.center.y],
            center_sigma_px: [sigma(4), sigma(5)],
            parameters: (calibration.model.names().iter().enumerate())
                .map(|(place, name)| Number {
                    name: (*name).to_owned(),
                    value: lens::parameter(&calibration.camera, calibration.model, place),
                    sigma: calibration.sigma(place),
                })
                .collect(),
            rotations,
            covariance: (calibration.covariance.row_iter())
                .map(|row| row.iter().copied().collect())
                .collect(),
            rms_px: calibration.rms_px,
            rms_without_turning_px: calibration.fixed_rms_px,
            corners_used: calibration.used,
            pictures,
            without_board,
            warnings,
        }
    }

    /// As a table for a terminal.
    pub fn table(&self) -> String {
        let mut text = String::new();
        // Writing to a String cannot fail.
        let _ = writeln!(
            text,
            "oblique scope, looking {:.2}° ± {:.2}° aside\n  RMS           {:.3} px ({:.1} px if turning were ignored), {} of {} corners used",
            self.obliqueness_deg,
            self.obliqueness_sigma_deg,
            self.rms_px,
            self.rms_without_turning_px,
            self.corners_used[0],
            self.corners_used[1]
        );
        let _ = writeln!(
            text,
            "  axis          {:.5} {:.5} {:.5} ± {:.3}° {:.3}°\n  point         {:.3} {:.3} {:.3} mm ± {:.3} {:.3}\n  \
             picture turns about {:.2} {:.2} px ± {:.2} {:.2}\n",
            self.axis[0],
            self.axis[1],
            self.axis[2],
            self.axis_sigma_deg[0],
            self.axis_sigma_deg[1],
            self.point_mm[0],
            self.point_mm[1],
            self.point_mm[2],
            self.point_sigma_mm[0],
            self.point_sigma_mm[1],
            self.center_px[0],
            self.center_px[1],
            self.center_sigma_px[0],
            self.center_sigma_px[1]
        );
        let _ = writeln!(
            text,
            "  {:<12}{:>10}{:>10}{:>10}",
            "rotation", "angle °", "sigma °", "given °"
        );
        for rotation in &self.rotations {
            let given = rotation.given_deg.map_or("-".into(), |given| format!("{given:.2}"));
            let sigma = if rotation.sigma_deg > 0.0 {
                format!("{:.3}", rotation.sigma_deg)
            } else {
                "held".into()
            };
            let _ = writeln!(
                text,
                "  {:<12}{:>10.3}{sigma:>10}{given:>10}",
                rotation.name, rotation.angle_deg
            );
        }
        let _ = writeln!(text, "\n  {:<6}{:>14}{:>14}", "", "at angle 0", "sigma");
        for number in &self.parameters {
            let digits = if number.name.starts_with(['f', 'c']) { 3 } else { 6 };
            let _ = writeln!(
                text,
                "  {:<6}{:>14.digits$}{:>14.digits$}",
                number.name, number.value, number.sigma
            );
        }
        let _ = writeln!(
            text,
            "\n  {:<28}{:>10}{:>10}{:>9}{:>6}{:>8}",
            "picture", "station", "rotation", "corners", "used", "RMS px"
        );
        for picture in &self.pictures {
            let _ = writeln!(
                text,
                "  {:<28}{:>10}{:>10}{:>9}{:>6}{:>8.3}",
                picture.name, picture.station, picture.rotation, picture.corners, picture.corners_used, picture.rms_px
            );
        }
        for picture in &self.without_board {
            let _ = writeln!(text, "  no board found in {picture}");
        }
        for warning in &self.warnings {
            let _ = writeln!(text, "  warning: {warning}");
        }
        text
    }
}
