//! What `calibrate hand-eye` tells: a table for people, JSON for machines.

use std::fmt::Write as _;

use nalgebra::Matrix6;
use serde::Serialize;

use crate::calibration::hand_eye::calibrate::{Held, StationView, calibrate, leave_out, stations};
use crate::calibration::hand_eye::hand_poses::HandPoses;
use crate::calibration::hand_eye::method::METHODS;
use crate::calibration::hand_eye::refinement::{Refined, Settings};
use crate::camera::model::CameraModel;
use crate::cli::calibrate::hand_eye_camera::CameraChange;
use crate::geometry::space::{Camera, Hand};
use crate::geometry::transform::Transform;

const JOINT_REFINEMENT: &str = "joint refinement";
/// The same with the camera held, beside a refinement that adjusted it.
const CAMERA_AS_GIVEN: &str = "camera as given";
/// An adjusted camera that is so many times worse at stations left out is warned of. Tuned on a simulated arm, whose right and wrong cameras
/// lay within 1.04 of each other, and on a real scope whose pictures told another camera than its arm did: 1.9.
const WORSE: f64 = 1.25;

/// One station.
#[derive(Debug, Serialize)]
pub struct View {
    pub name: String,
    pub corners: usize,
    /// What the arm alone predicts, RMS px.
    pub predicted_px: f64,
    /// Correction of the hand: shift mm, turn degrees.
    pub correction_mm: f64,
    pub correction_deg: f64,
    /// Square of the correction in deviations that the middle station tells: about 6 for one like the others.
    pub distance: f64,
    /// Not heard: the arm was not where it said.
    pub wrong: bool,
    /// Predicted from a calibration on the others.
    pub left_out_px: Option<f64>,
    pub left_out_mm: Option<f64>,
}

/// A method beside the others.
#[derive(Debug, Serialize)]
pub struct Compared {
    pub method: &'static str,
    /// Difference to the joint refinement.
    pub off_mm: Option<f64>,
    pub off_deg: Option<f64>,
    /// Mean and median over views left out.
    pub left_out_px: Option<[f64; 2]>,
    pub left_out_mm: Option<[f64; 2]>,
}

/// How the camera sits on the hand, and how surely.
#[derive(Debug, Serialize)]
pub struct Placement {
    pub translation_mm: [f64; 3],
    pub rotation_xyzw: [f64; 4],
    pub sigma_mm: [f64; 3],
    pub sigma_deg: [f64; 3],
    /// Of the shift (mm) and the rotation vector (rad), in the hand's space.
    pub covariance: [[f64; 6]; 6],
}

impl Placement {
    pub fn new(hand_from_camera: &Transform<Hand, Camera>, covariance: &Matrix6<f64>) -> Self {
        let deviation = |i: usize| covariance[(i, i)].max(0.0).sqrt();
        let q = hand_from_camera.rotation();
        Self {
            translation_mm: hand_from_camera.translation().into(),
            rotation_xyzw: [q.i, q.j, q.k, q.w],
            sigma_mm: std::array::from_fn(deviation),
            sigma_deg: std::array::from_fn(|axis| deviation(axis + 3).to_degrees()),
            covariance: std::array::from_fn(|row| std::array::from_fn(|column| covariance[(row, column)])),
        }
    }

    /// Two lines of a table.
    pub fn lines(&self) -> String {
        let ([x, y, z], [sx, sy, sz]) = (self.translation_mm, self.sigma_mm);
        let ([qx, qy, qz, qw], [rx, ry, rz]) = (self.rotation_xyzw, self.sigma_deg);
        format!(
            "  translation   {x:.3} {y:.3} {z:.3} mm  (± {sx:.3} {sy:.3} {sz:.3})
  rotation      {qx:.5} {qy:.5} {qz:.5} {qw:.5} xyzw  (± {rx:.3} {ry:.3} {rz:.3}°)
"
        )
    }
}

/// All figures.
#[derive(Debug, Serialize)]
pub struct Report {
    pub version: &'static str,
    #[serde(flatten)]
    pub placement: Placement,
    pub base_from_board_mm: [f64; 3],
    pub rms_px: f64,
    pub arm_sigma_mm: f64,
    pub arm_sigma_deg: f64,
    pub corner_sigma_px: f64,
    pub time_offset_ms: Option<[f64; 2]>,
    pub joint_offsets: Vec<[f64; 2]>,
    pub views: Vec<View>,
    pub methods: Vec<Compared>,
    /// The camera, if it was adjusted too.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub camera: Option<CameraChange>,
    pub left_out_pictures: Vec<String>,
    pub warnings: Vec<String>,
}

impl Report {
    pub fn new(
        refined: &Refined,
        views: &[StationView],
        hands: &dyn HandPoses,
        camera: &CameraModel,
        settings: &Settings,
        names: &[String],
        left_out_pictures: Vec<String>,
        camera_change: Option<CameraChange>,
    ) -> Self {
        let held = leave_out(views, hands, camera, &begun(settings, refined), None);
        let x = refined.hand_from_camera;
        let placement = Placement::new(&x, &refined.covariance);
        let reports: Vec<View> = (names.iter().enumerate())
            .map(|(view, name)| View {
                name: name.clone(),
                corners: views[view].sightings.len(),
                predicted_px: refined.predicted_px[view],
                correction_mm: refined.corrections[view].fixed_rows::<3>(0).norm(),
                correction_deg: refined.corrections[view].fixed_rows::<3>(3).norm().to_degrees(),
                distance: refined.distance[view],
                wrong: refined.outlier[view],
                left_out_px: held[view].map(|held| held.rms_px),
                left_out_mm: held[view].map(|held| held.board_mm),
            })
            .collect();
        let stations = stations(views, hands);
        let mut methods: Vec<Compared> = vec![compared(JOINT_REFINEMENT, Some(x), &x, &held)];
        if settings.camera_prior.is_some() {
            methods.push(by_the_camera_given(views, hands, camera, settings, &x));
        }
        methods.extend(METHODS.iter().map(|&method| {
            let held = leave_out(views, hands, camera, settings, Some(method));
            compared(method.name(), method.solve(&stations), &x, &held)
        }));
        let mut warnings = camera_change.as_ref().map_or_else(Vec::new, |change| change.warnings.clone());
        warnings.extend(worse_adjusted(&methods));
        let wrong: Vec<String> = reports
            .iter()
            .filter(|view| view.wrong)
            .map(|view| view.name.clone())
            .collect();
        if !wrong.is_empty() {
            warnings.push(format!("the arm was not where it said at {}: not used", listed(&wrong)));
        }
        if views.len() < 8 {
            warnings.push(format!("only {} stations: ten to thirty make the answer sure", views.len()));
        }
        if placement.sigma_mm.iter().any(|sigma| *sigma > 1.0) {
            warnings
                .push("the camera's place is unsure by more than 1 mm: add stations, tilted farther and about other axes".into());
        }
        Self {
            version: env!("CARGO_PKG_VERSION"),
            placement,
            base_from_board_mm: refined.base_from_board.translation().into(),
            rms_px: refined.rms_px,
            arm_sigma_mm: refined.sigmas[0],
            arm_sigma_deg: refined.sigmas[1].to_degrees(),
            corner_sigma_px: refined.sigmas[2],
            time_offset_ms: settings.time_offset.then(|| refined.time_offset_s.map(|s| 1000.0 * s)),
            joint_offsets: refined.joint_offsets.clone(),
            views: reports,
            methods,
            camera: camera_change,
            left_out_pictures,
            warnings,
        }
    }

    pub fn table(&self) -> String {
        let mut text = String::new();
        // Writing to a String cannot fail.
        let _ = writeln!(text, "hand_from_camera, {} stations", self.views.len());
        text += &self.placement.lines();
        if let Some([offset, sigma]) = self.time_offset_ms {
            let _ = writeln!(
                text,
                "  time offset   {offset:.1} ms  (± {sigma:.1}), added to the arm's stamps"
            );
        }
        for (joint, [offset, sigma]) in self.joint_offsets.iter().enumerate() {
            let _ = writeln!(text, "  joint {}       {offset:.5} (± {sigma:.5}) mm or rad", joint + 1);
        }
        if let Some(camera) = &self.camera {
            text += &camera.lines();
        }
        let _ = writeln!(
            text,
            "  arm's noise   {:.3} mm, {:.4}° a station; corners {:.3} px; RMS {:.3} px with the stations corrected",
            self.arm_sigma_mm, self.arm_sigma_deg, self.corner_sigma_px, self.rms_px
        );
        let _ = writeln!(
            text,
            "\n  station                        corners  arm alone  correction     distance  left out"
        );
        for view in &self.views {
            let held = match (view.left_out_px, view.left_out_mm) {
                (Some(px), Some(mm)) => format!("{px:.2} px {mm:.2} mm"),
                _ => "–".to_owned(),
            };
            let _ = writeln!(
                text,
                "  {:<30} {:>7}  {:>6.2} px  {:.2} mm {:>6.3}° {:>7.1}  {held}{}",
                view.name,
                view.corners,
                view.predicted_px,
                view.correction_mm,
                view.correction_deg,
                view.distance.sqrt(),
                if view.wrong { "  WRONG" } else { "" }
            );
        }
        let given = if self.camera.is_some() {
            "; closed forms by the camera as given"
        } else {
            ""
        };
        let _ = writeln!(
            text,
            "\n  method             differs by           stations left out, mean (median){given}"
        );
        for method in &self.methods {
            let off = match (method.off_mm, method.off_deg) {
                (Some(mm), Some(deg)) => format!("{mm:.3} mm {deg:.3}°"),
                _ => "no answer".to_owned(),
            };
            let held = match (method.left_out_px, method.left_out_mm) {
                (Some([px, middle_px]), Some([mm, middle_mm])) => {
                    format!("{px:.3} ({middle_px:.3}) px {mm:.3} ({middle_mm:.3}) mm")
                }
                _ => "–".to_owned(),
            };
            let _ = writeln!(text, "  {:<18} {off:<20} {held}", method.method);
        }
        for warning in &self.warnings {
            let _ = writeln!(text, "  ! {warning}");
        }
        text
    }
}

/// The search for deviations on some of the views begins where that on all ended; it ends where those views lead it.
fn begun(settings: &Settings, refined: &Refined) -> Settings {
    Settings {
        place_sigma_mm: refined.sigmas[0],
        turn_sigma_rad: refined.sigmas[1],
        pixel_sigma: refined.sigmas[2],
        ..settings.clone()
    }
}

/// The same refinement with the camera held.
fn by_the_camera_given(
    views: &[StationView],
    hands: &dyn HandPoses,
    camera: &CameraModel,
    settings: &Settings,
    reference: &Transform<Hand, Camera>,
) -> Compared {
    let held_still = Settings {
        camera_prior: None,
        ..settings.clone()
    };
    let found = calibrate(views, hands, camera, &held_still).ok();
    let begun = found
        .as_ref()
        .map_or_else(|| held_still.clone(), |found| begun(&held_still, found));
    let held = leave_out(views, hands, camera, &begun, None);
    compared(CAMERA_AS_GIVEN, found.map(|found| found.hand_from_camera), reference, &held)
}

/// A sentence if stations left out speak against the adjusted camera. The median is asked, as one wrong station spoils any mean.
fn worse_adjusted(methods: &[Compared]) -> Option<String> {
    let median_px = |name: &str| {
        let method = methods.iter().find(|method| method.method == name)?;
        method.left_out_px.map(|[_, median]| median)
    };
    let (adjusted, given) = (median_px(JOINT_REFINEMENT)?, median_px(CAMERA_AS_GIVEN)?);
    (adjusted > WORSE * given).then(|| {
        format!(
            "the arm speaks against the adjusted camera: stations left out are predicted to {adjusted:.2} px (median), with the camera as \
             given to {given:.2} px. Leave --refine-camera out, or calibrate the camera anew: a board that is not flat, or a lens that its model \
             does not describe, can look like another camera"
        )
    })
}

fn compared(
    method: &'static str,
    found: Option<Transform<Hand, Camera>>,
    reference: &Transform<Hand, Camera>,
    held: &[Option<Held>],
) -> Compared {
    let summed = |of: &dyn Fn(&Held) -> f64| {
        let values: Option<Vec<f64>> = held.iter().map(|held| held.as_ref().map(of)).collect();
        let mut values = values.filter(|values| !values.is_empty())?;
        values.sort_by(f64::total_cmp);
        let middle = values.len() / 2;
        let median = 0.5 * (values[middle] + values[(values.len() - 1) / 2]);
        Some([values.iter().sum::<f64>() / values.len() as f64, median])
    };
    Compared {
        method,
        off_mm: found.map(|found| (found.translation() - reference.translation()).norm()),
        off_deg: found.map(|found| found.rotation().angle_to(&reference.rotation()).to_degrees()),
        left_out_px: summed(&|held| held.rms_px),
        left_out_mm: summed(&|held| held.board_mm),
    }
}

/// The first few names.
pub fn listed(names: &[String]) -> String {
    const MOST: usize = 4;
    let shown = names.iter().take(MOST).cloned().collect::<Vec<_>>().join(", ");
    if names.len() > MOST {
        format!("{shown} and {} more", names.len() - MOST)
    } else {
        shown
    }
}
