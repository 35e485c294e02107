//! The camera in `calibrate hand-eye --refine-camera`: what is known of it before, what became of it, and the file that takes it.

use std::fmt::Write as _;
use std::path::Path;

use anyhow::Context as _;
use nalgebra::DMatrix;
use serde::{Deserialize, Serialize};

use crate::calibration::camera::lens::{self, LensModel};
use crate::calibration::hand_eye::camera_prior::{
    ASSUMED_CENTER_SHARE, ASSUMED_FOCAL_SHARE, ASSUMED_RADIAL, ASSUMED_TANGENTIAL, CameraPrior,
};
use crate::calibration::hand_eye::refinement::Refined;
use crate::camera::file;
use crate::camera::model::CameraModel;

/// A report's numbers are those of the camera file if they differ by no more than this share; files made by hand are rounded.
const SAME: f64 = 1e-5;
/// A number that moved by more of its prior's deviations than this did so for another reason.
const MOVED: f64 = 3.0;

/// What is known of the camera.
#[derive(Debug)]
pub struct Known {
    pub prior: CameraPrior,
    /// Where that comes from, half a sentence.
    pub origin: String,
    /// Why it does not come from the camera's own calibration, though there seems to be one.
    pub warning: Option<String>,
}

impl Known {
    /// By the report that `calibrate camera` laid beside the camera file; without one, assumed.
    pub fn of(camera: &CameraModel, camera_file: &Path) -> anyhow::Result<Self> {
        let report = crate::cli::calibrate::beside(camera_file, "_report.json");
        let mut warning = None;
        if report.is_file() {
            match told(&report, camera) {
                Ok(prior) => {
                    return Ok(Self {
                        prior,
                        origin: format!("deviations by {}", report.display()),
                        warning: None,
                    });
                }
                Err(why) => {
                    warning = Some(format!(
                        "{}: {why}: the camera's deviations are assumed; `endofield calibrate camera` writes both files anew",
                        report.display()
                    ));
                }
            }
        }
        Ok(Self {
            prior: CameraPrior::assumed(camera)
                .context("the camera file's numbers are no camera's: calibrate the camera again")?,
            origin: format!(
                "deviations assumed: focal lengths {} %, centre {} % of the width, lens {ASSUMED_RADIAL} radial and {ASSUMED_TANGENTIAL} \
                 tangential",
                100.0 * ASSUMED_FOCAL_SHARE,
                100.0 * ASSUMED_CENTER_SHARE
            ),
            warning,
        })
    }
}

/// What is read of a camera's report.
#[derive(Deserialize)]
struct CameraReport {
    parameters: Vec<Number>,
    covariance: Option<Vec<Vec<f64>>>,
}

#[derive(Deserialize)]
struct Number {
    name: String,
    value: f64,
}

fn told(path: &Path, camera: &CameraModel) -> anyhow::Result<CameraPrior> {
    let text = std::fs::read_to_string(path).context("cannot be read")?;
    let report: CameraReport = serde_json::from_str(&text).context("is not a report of a camera")?;
    let names: Vec<&str> = report.parameters.iter().map(|number| number.name.as_str()).collect();
    let model = [LensModel::PlumbBob, LensModel::RationalPolynomial, LensModel::Equidistant]
        .into_iter()
        .find(|model| model.names() == names)
        .with_context(|| format!("its numbers {names:?} are those of no lens model"))?;
    for (place, number) in report.parameters.iter().enumerate() {
        let given = lens::parameter(camera, model, place);
        anyhow::ensure!(
            (given - number.value).abs() <= SAME * number.value.abs().max(1.0),
            "it is of another camera ({} {} where the camera file has {given})",
            number.name,
            number.value
        );
    }
    let rows = report.covariance.context("it tells no covariance")?;
    let count = names.len();
    // The report of an oblique scope goes on with its joint.
    anyhow::ensure!(
        rows.len() >= count && rows.iter().take(count).all(|row| row.len() >= count),
        "its covariance has {} rows, expected {count} or more",
        rows.len()
    );
    CameraPrior::calibrated(model, DMatrix::from_fn(count, count, |row, column| rows[row][column]))
        .context("its covariance is not that of numbers")
}

/// A number of the camera, before and after.
#[derive(Debug, Serialize)]
struct Change {
    name: &'static str,
    given: f64,
    /// Deviation before.
    given_sigma: f64,
    value: f64,
    /// Deviation after.
    sigma: f64,
}

/// What became of the camera.
#[derive(Debug, Serialize)]
pub struct CameraChange {
    /// Where the deviations before come from.
    pub prior: String,
    parameters: Vec<Change>,
    /// Of the parameters, in their order.
    covariance: Vec<Vec<f64>>,
    #[serde(skip)]
    pub warnings: Vec<String>,
}

impl CameraChange {
    /// `None` if the camera was not adjusted.
    pub fn new(refined: &Refined, given: &CameraModel, known: &Known) -> Option<Self> {
        let covariance = refined.camera_covariance.as_ref()?;
        let (prior, model) = (&known.prior, known.prior.model());
        let sigma = |covariance: &DMatrix<f64>, place: usize| covariance[(place, place)].max(0.0).sqrt();
        let parameters: Vec<Change> = (model.names().iter().enumerate().take(prior.count()))
            .map(|(place, name)| Change {
                name,
                given: lens::parameter(given, model, place),
                given_sigma: sigma(prior.covariance(), place),
                value: lens::parameter(&refined.camera, model, place),
                sigma: sigma(covariance, place),
            })
            .collect();
        let mut warnings: Vec<String> = known.warning.iter().cloned().collect();
        let moved: Vec<&str> = (parameters.iter())
            .filter(|change| (change.value - change.given).abs() > MOVED * change.given_sigma)
            .map(|change| change.name)
            .collect();
        if !moved.is_empty() {
            warnings.push(format!(
                "the camera differs from its file by more than was thought possible ({}): if its focus, zoom or coupler was touched since, \
                 calibrate the camera again; else the arm's errors are no noise, and the camera as given is the better one",
                moved.join(", ")
            ));
        }
        let k = &refined.camera.intrinsics;
        let (right, bottom) = (refined.camera.width as f64 - 1.0, refined.camera.height as f64 - 1.0);
        let reach_px = k.cx.max(right - k.cx).hypot(k.cy.max(bottom - k.cy));
        if let Some(fold) = lens::fold_px(&refined.camera, reach_px)
            && lens::fold_px(given, reach_px).is_none()
        {
            warnings.push(format!(
                "the adjusted lens turns back on itself {fold:.0} px from the picture's middle: show the board near the border too, or \
                 keep the camera as given"
            ));
        }
        Some(Self {
            prior: known.origin.clone(),
            parameters,
            covariance: covariance.row_iter().map(|row| row.iter().copied().collect()).collect(),
            warnings,
        })
    }

    /// Lines of a table.
    pub fn lines(&self) -> String {
        let mut text = format!("  camera        adjusted too; {}\n", self.prior);
        for change in &self.parameters {
            let digits = if change.given.abs() < 10.0 { 5 } else { 2 };
            // Writing to a String cannot fail.
            let _ = writeln!(
                text,
                "    {:<4} {:>11.digits$} → {:>11.digits$}  ({:+.digits$} ± {:.digits$}; before ± {:.digits$})",
                change.name,
                change.given,
                change.value,
                change.value - change.given,
                change.sigma,
                change.given_sigma
            );
        }
        text
    }
}

/// Write the adjusted camera, with the joint of an oblique scope if the file it comes from has one.
pub fn write(path: &Path, camera: &CameraModel, given: &Path) -> anyhow::Result<()> {
    match file::read_oblique(given)? {
        Some(oblique) => file::write_oblique(path, camera, &oblique, "endofield")?,
        None => file::write(path, camera, "endofield")?,
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::distortion::Distortion;
    use crate::camera::intrinsics::Intrinsics;

    fn camera() -> CameraModel {
        CameraModel {
            width: 640,
            height: 480,
            intrinsics: Intrinsics {
                fx: 500.0,
                fy: 501.0,
                cx: 320.0,
                cy: 240.0,
            },
            distortion: Distortion::KannalaBrandt {
                k: [-0.02, 0.003, 0.0, 0.0],
            },
        }
    }

    /// A report with deviations of 0.5, for `count` rows.
    fn report(fx: f64, count: usize) -> String {
        let mut values = vec![fx, 501.0, 320.0, 240.0, -0.02, 0.003, 0.0, 0.0];
        let names = LensModel::Equidistant.names().iter();
        let parameters: Vec<_> = (names.zip(values.drain(..)))
            .map(|(name, value)| serde_json::json!({"name": name, "value": value, "sigma": 0.5}))
            .collect();
        let covariance = DMatrix::<f64>::identity(count, count) * 0.25;
        let rows: Vec<Vec<f64>> = covariance.row_iter().map(|row| row.iter().copied().collect()).collect();
        serde_json::json!({"parameters": parameters, "covariance": rows}).to_string()
    }

    #[test]
    fn a_report_tells_the_deviations_if_it_is_of_this_camera() {
        let folder = tempfile::tempdir().unwrap();
        let (file, beside) = (folder.path().join("scope.yaml"), folder.path().join("scope_report.json"));
        let assumed = Known::of(&camera(), &file).unwrap();
        assert!(
            assumed.warning.is_none() && assumed.origin.contains("assumed: focal lengths 1 %"),
            "{assumed:?}"
        );
        // An oblique scope's report has rows for its joint too.
        for rows in [8, 14] {
            std::fs::write(&beside, report(500.0, rows)).unwrap();
            let told = Known::of(&camera(), &file).unwrap();
            assert!(
                told.warning.is_none() && told.origin.contains("scope_report.json"),
                "{told:?}"
            );
            assert!(told.prior.count() == 8 && told.prior.covariance()[(7, 7)] == 0.25);
        }
        for (text, word) in [
            (report(510.0, 8), "another camera (fx 510"),
            (report(500.0, 5), "5 rows"),
            (report(500.0, 8).replace("\"fx\"", "\"f\""), "no lens model"),
            (report(500.0, 8).replace("0.25", "-1"), "not that of numbers"),
            ("{".into(), "not a report"),
        ] {
            std::fs::write(&beside, text).unwrap();
            let known = Known::of(&camera(), &file).unwrap();
            let warning = known.warning.unwrap();
            assert!(
                warning.contains(word) && known.prior == assumed.prior,
                "`{warning}` should say `{word}`"
            );
        }
    }
}
