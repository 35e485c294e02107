//! What a calibration tells its user: a table for people, JSON for machines.

use std::fmt::Write as _;

use serde::Serialize;

use crate::calibration::board::placement::Naming;
use crate::calibration::camera::coverage::{self, Coverage, Lit};
use crate::calibration::camera::cross_validation::Difference;
use crate::calibration::camera::lens;
use crate::calibration::camera::refine::{Calibration, ViewResult};

/// A view whose RMS is this many times the median view's stands out.
const OUTLIER_VIEW: f64 = 2.5;
/// A view better than this does not, px.
const GOOD_VIEW_PX: f64 = 0.25;

/// One number of the camera.
#[derive(Clone, Debug, Serialize)]
pub struct Parameter {
    /// fx, k1, …
    pub name: &'static str,
    /// As estimated.
    pub value: f64,
    /// Standard deviation; none if the views do not determine it.
    pub sigma: Option<f64>,
}

/// Agreement of the two halves of the views.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct CrossValidation {
    /// In the covered part of the picture, px.
    pub median_px: f64,
    /// In the covered part of the picture, px.
    pub worst_px: f64,
}

/// Where a board lay.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Pose {
    /// x y z, mm.
    pub translation_mm: [f64; 3],
    /// x y z w.
    pub rotation_xyzw: [f64; 4],
}

/// One picture.
#[derive(Clone, Debug, Serialize)]
pub struct ViewReport {
    /// File or frame.
    pub name: String,
    /// Corners found.
    pub corners: usize,
    /// Corners that took part.
    pub used: usize,
    /// Over residual vectors of the corners used, px.
    pub rms_px: Option<f64>,
    /// Longest residual of the corners used, px.
    pub worst_px: Option<f64>,
    /// How sure it is which corner is which.
    pub naming: Naming,
    /// Camera from board.
    pub camera_from_board: Option<Pose>,
    /// Stands out among the views.
    pub outlier: bool,
}

/// A picture without a board.
#[derive(Clone, Debug, Serialize)]
pub struct NotFound {
    /// File or frame.
    pub name: String,
    /// Half a sentence.
    pub why: String,
}

/// A corner left out.
#[derive(Clone, Debug, Serialize)]
pub struct OutlierCorner {
    /// File or frame.
    pub view: String,
    /// On the board, mm.
    pub board_mm: [f64; 2],
    /// In the picture.
    pub pixel: [f64; 2],
    /// px.
    pub error_px: f64,
}

/// All that is told.
#[derive(Clone, Debug, Serialize)]
pub struct Report {
    /// Version of the program.
    pub version: &'static str,
    /// As typed.
    pub board: String,
    /// Of a square, mm.
    pub square_mm: f64,
    /// Of a dot, mm: as given or as measured.
    pub dot_radius_mm: Option<f64>,
    /// Columns and rows.
    pub image_size: [usize; 2],
    /// ROS's name of the lens model.
    pub model: &'static str,
    /// Pictures looked at.
    pub pictures: usize,
    /// Pictures in which no board was found, and why.
    pub without_board: Vec<NotFound>,
    /// Corners found and used.
    pub corners: usize,
    /// Corners used.
    pub corners_used: usize,
    /// Over residual vectors of the corners used, px.
    pub rms_px: f64,
    /// Standard deviation of a corner per axis, px.
    pub sigma_px: f64,
    /// The camera.
    pub parameters: Vec<Parameter>,
    /// Of the parameters, in their order.
    pub covariance: Option<Vec<Vec<f64>>>,
    /// Halves of the views against each other.
    pub cross_validation: Option<CrossValidation>,
    /// Where corners were seen.
    pub coverage: Coverage,
    /// One for each picture with a board.
    pub views: Vec<ViewReport>,
    /// Corners left out.
    pub outlier_corners: Vec<OutlierCorner>,
    /// What to mend.
    pub warnings: Vec<String>,
}

/// What the calibration does not know of itself.
#[derive(Clone, Debug)]
pub struct Circumstances {
    /// As typed.
    pub board: String,
    /// Of a square, mm.
    pub square_mm: f64,
    /// Of a dot, mm.
    pub dot_radius_mm: Option<f64>,
    /// Names of the views, in the order of the calibration's.
    pub names: Vec<String>,
    /// How sure their corners' names are.
    pub namings: Vec<Naming>,
    /// Pictures in which no board was found.
    pub without_board: Vec<NotFound>,
    /// Where light fell in any picture.
    pub lit: Lit,
}

impl Report {
    /// Of a calibration.
    pub fn new(calibration: &Calibration, difference: Option<&Difference>, circumstances: &Circumstances) -> Self {
        let coverage = coverage::coverage(calibration, &circumstances.lit);
        let mut warnings = coverage::warnings(calibration, &coverage);
        let mut views: Vec<ViewReport> = (calibration.views.iter().enumerate())
            .map(|(number, view)| view_report(view, &circumstances.names[number], circumstances.namings[number]))
            .collect();
        mark_outliers(&mut views);
        let outlier_corners: Vec<OutlierCorner> = (calibration.views.iter().zip(&circumstances.names))
            .flat_map(|(view, name)| left_out(view, name))
            .collect();
        let odd: Vec<&str> = views
            .iter()
            .filter(|view| view.outlier)
            .map(|view| view.name.as_str())
            .collect();
        if !odd.is_empty() {
            warnings.push(format!("look at {}: much worse than the other views", odd.join(", ")));
        }
        let (corners, corners_used) = views
            .iter()
            .fold((0, 0), |(all, used), view| (all + view.corners, used + view.used));
        if corners_used * 20 < corners * 19 {
            warnings.push(format!(
                "{} of {corners} corners were left out as too far off",
                corners - corners_used
            ));
        }
        if let Some(difference) = difference
            && difference.median_px > 3.0 * calibration.rms_px.max(0.1)
        {
            warnings.push(format!(
                "two halves of the views differ by {:.2} px (median): more and better spread views are needed",
                difference.median_px
            ));
        }
        if circumstances.namings.iter().all(|naming| *naming == Naming::Shifted) {
            let most = views.iter().map(|view| view.corners).max().unwrap_or(0);
            warnings.push(format!(
                "no picture shows just the whole board: {most} corners at most were found; that does no harm to the camera, but check that \
                 {} counts its columns and rows rightly (of a checkerboard, inner corners)",
                circumstances.board
            ));
        }
        let covariance = calibration.covariance.as_ref();
        Self {
            version: env!("CARGO_PKG_VERSION"),
            board: circumstances.board.clone(),
            square_mm: circumstances.square_mm,
            dot_radius_mm: circumstances.dot_radius_mm,
            image_size: [calibration.camera.width, calibration.camera.height],
            model: calibration.model.ros_name(),
            pictures: views.len() + circumstances.without_board.len(),
            without_board: circumstances.without_board.clone(),
            corners,
            corners_used,
            rms_px: calibration.rms_px,
            sigma_px: calibration.sigma_px,
            parameters: (calibration.model.names().iter().enumerate())
                .map(|(place, name)| Parameter {
                    name,
                    value: lens::parameter(&calibration.camera, calibration.model, place),
                    sigma: covariance.map(|c| c[(place, place)].max(0.0).sqrt()),
                })
                .collect(),
            covariance: covariance.map(|c| c.row_iter().map(|row| row.iter().copied().collect()).collect()),
            cross_validation: difference.map(|difference| CrossValidation {
                median_px: difference.median_px,
                worst_px: difference.worst_px,
            }),
            coverage,
            views,
            outlier_corners,
            warnings,
        }
    }

    /// As a table for a terminal.
    pub fn table(&self) -> String {
        let mut text = String::new();
        // Writing to a String cannot fail.
        let _ = writeln!(
            text,
            "camera {}x{}, {}, board {} of {} mm\n  boards        {} of {} pictures, {} of {} corners used",
            self.image_size[0],
            self.image_size[1],
            self.model,
            self.board,
            self.square_mm,
            self.views.len(),
            self.pictures,
            self.corners_used,
            self.corners
        );
        let _ = writeln!(
            text,
            "  RMS           {:.3} px (over residual vectors; {:.3} px per axis)",
            self.rms_px, self.sigma_px
        );
        match &self.cross_validation {
            Some(cross) => {
                let _ = writeln!(
                    text,
                    "  halves differ {:.3} px median, {:.3} px worst, where corners were seen",
                    cross.median_px, cross.worst_px
                );
            }
            None => text.push_str("  halves differ (too few views to tell)\n"),
        }
        let c = &self.coverage;
        let _ = writeln!(
            text,
            "  coverage      {:.0} % of the image field; tilt {:.0}°–{:.0}°; distance {:.0}–{:.0} mm",
            c.share * 100.0,
            c.tilt_degrees[0],
            c.tilt_degrees[1],
            c.distance_mm[0],
            c.distance_mm[1]
        );
        let _ = writeln!(text, "\n  {:<6}{:>14}{:>14}", "", "value", "sigma");
        for parameter in &self.parameters {
            let digits = if parameter.name.starts_with(['f', 'c']) { 3 } else { 6 };
            let sigma = parameter
                .sigma
                .map_or("undetermined".into(), |sigma| format!("{sigma:.digits$}"));
            let _ = writeln!(text, "  {:<6}{:>14.digits$}{sigma:>14}", parameter.name, parameter.value);
        }
        let widest = self
            .views
            .iter()
            .map(|view| view.name.chars().count())
            .max()
            .unwrap_or(0)
            .max(4);
        let _ = writeln!(text, "\n  {:<widest$}  corners   used    RMS px  worst px", "view");
        for view in &self.views {
            let number = |value: Option<f64>| value.map_or("-".into(), |value| format!("{value:.3}"));
            let _ = writeln!(
                text,
                "  {:<widest$}  {:>7}{:>7}{:>10}{:>10}{}{}",
                view.name,
                view.corners,
                view.used,
                number(view.rms_px),
                number(view.worst_px),
                if view.outlier { "  outlier" } else { "" },
                if view.naming == Naming::Shifted {
                    "  part of a board"
                } else {
                    ""
                },
            );
        }
        for corner in self.outlier_corners.iter().take(8) {
            let _ = writeln!(
                text,
                "  left out: {} corner at ({:.0}, {:.0}), board ({}, {}) mm, {:.2} px off",
                corner.view, corner.pixel[0], corner.pixel[1], corner.board_mm[0], corner.board_mm[1], corner.error_px
            );
        }
        if self.outlier_corners.len() > 8 {
            let _ = writeln!(text, "  … and {} more", self.outlier_corners.len() - 8);
        }
        for picture in &self.without_board {
            let _ = writeln!(text, "  no board found in {}: {}", picture.name, picture.why);
        }
        for warning in &self.warnings {
            let _ = writeln!(text, "  warning: {warning}");
        }
        text
    }
}

fn view_report(view: &ViewResult, name: &str, naming: Naming) -> ViewReport {
    let squares: Vec<f64> = (view.residuals.iter())
        .filter(|residual| residual.used)
        .map(|residual| residual.error_px[0].powi(2) + residual.error_px[1].powi(2))
        .collect();
    let any = !squares.is_empty();
    ViewReport {
        name: name.to_owned(),
        corners: view.residuals.len(),
        used: squares.len(),
        rms_px: any.then(|| (squares.iter().sum::<f64>() / squares.len() as f64).sqrt()),
        worst_px: any.then(|| squares.iter().copied().fold(0.0, f64::max).sqrt()),
        naming,
        camera_from_board: view.camera_from_board.map(|pose| Pose {
            translation_mm: pose.translation().into(),
            rotation_xyzw: pose.rotation().coords.into(),
        }),
        outlier: false,
    }
}

fn mark_outliers(views: &mut [ViewReport]) {
    let mut all: Vec<f64> = views.iter().filter_map(|view| view.rms_px).collect();
    all.sort_by(f64::total_cmp);
    let median = all.get(all.len() / 2).copied().unwrap_or(0.0);
    for view in views {
        view.outlier = view.rms_px.is_none_or(|rms| rms > (OUTLIER_VIEW * median).max(GOOD_VIEW_PX));
    }
}

fn left_out<'a>(view: &'a ViewResult, name: &'a str) -> impl Iterator<Item = OutlierCorner> + 'a {
    view.residuals
        .iter()
        .filter(|residual| !residual.used)
        .map(move |residual| OutlierCorner {
            view: name.to_owned(),
            board_mm: [residual.corner.board.coords.x, residual.corner.board.coords.y],
            pixel: [residual.corner.pixel.x, residual.corner.pixel.y],
            error_px: residual.error_px[0].hypot(residual.error_px[1]),
        })
}
