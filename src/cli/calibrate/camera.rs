//! `calibrate camera`: intrinsics and lens from pictures of a board.

use std::path::PathBuf;

use serde_json::{Value, json};

use crate::calibration::board::detection::{Detection, detect, why_not};
use crate::calibration::board::pattern::BoardLayout;
use crate::calibration::camera::coverage::Lit;
use crate::calibration::camera::cross_validation::cross_validated;
use crate::calibration::camera::lens::LensModel;
use crate::calibration::camera::plot;
use crate::calibration::camera::refine::{Calibration, View, calibrate};
use crate::calibration::camera::report::{Circumstances, NotFound, Report};
use crate::calibration::error::{CalibrationError, LEAST_VIEWS};
use crate::camera::file;
use crate::cli::calibrate::pictures::{Seen, look_at_all};
use crate::cli::calibrate::{beside, say_written, write_json};
use crate::cli::console;
use crate::cli::context::{Context, Ended, UsageError};
use crate::image::buffer::{Image, Rgb8};
use crate::media::image_files;

/// Measure intrinsics and lens from pictures of a board.
#[derive(Debug, clap::Args)]
#[command(after_help = "Boards (KIND:COLUMNSxROWS):
  checkerboard:9x6            inner corners (where four squares meet), as in OpenCV
  charuco:19x26:4:4x4_250     squares, side of a marker in mm, dictionary (4x4, 5x5, 6x6, 7x7 of 50, 100, 250, 1000; 4x4_250 if left out);
                              add :legacy if the rows are even in number and the first square bears a marker (OpenCV before 4.6)
  circles:7x5[:2.5]           dots; diameter in mm (measured if left out); --square-mm is the distance of two dots
  acircles:4x11[:2.5]         11 rows of 4 dots, every other row shifted; --square-mm is half the distance of two dots in a row

Examples:
  endofield calibrate camera pictures/*.png --board checkerboard:9x6 --square-mm 4 -o camera.yaml
  endofield calibrate camera survey/ --board charuco:12x9:3:5x5_100 --square-mm 4 -o camera.yaml
  endofield calibrate camera scope.mp4 --board acircles:3x11 --square-mm 1 --model equidistant -o camera.yaml

Beside camera.yaml are written camera_report.json (all figures, with covariance) and camera_report.png (residual vectors, and where two
halves of the views disagree).")]
pub struct Args {
    /// Pictures, folders of pictures, videos or recordings.
    #[arg(required = true, value_name = "IMAGES")]
    images: Vec<PathBuf>,
    /// The board, such as checkerboard:9x6 (see below).
    #[arg(long)]
    board: String,
    /// Side of a square or distance of dots, mm.
    #[arg(long, value_name = "MM")]
    square_mm: f64,
    /// Lens model.
    #[arg(long, value_enum, default_value_t = Model::PlumbBob)]
    model: Model,
    /// Camera file to write (ROS camera_info).
    #[arg(short, long, default_value = "camera.yaml", value_name = "FILE")]
    output: PathBuf,
    /// Frames looked at, of a recording or video.
    #[arg(long, default_value_t = 40, value_parser = clap::value_parser!(u32).range(3..=1000))]
    frames: u32,
    /// Write all corners found, with their residuals, as JSON.
    #[arg(long, value_name = "FILE")]
    corners_out: Option<PathBuf>,
}

/// A lens model, as the user names it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Model {
    /// k1 k2 p1 p2 k3: rigid scopes.
    #[value(name = "plumb_bob")]
    PlumbBob,
    /// k1 k2 p1 p2 k3 k4 k5 k6: very wide lenses.
    #[value(name = "rational_polynomial")]
    RationalPolynomial,
    /// Kannala–Brandt k1 k2 k3 k4: fisheyes.
    #[value(name = "equidistant")]
    Equidistant,
}

impl Model {
    /// The same, as the solver names it.
    pub fn lens(self) -> LensModel {
        match self {
            Self::PlumbBob => LensModel::PlumbBob,
            Self::RationalPolynomial => LensModel::RationalPolynomial,
            Self::Equidistant => LensModel::Equidistant,
        }
    }
}

/// What came of a picture.
struct Looked {
    found: Result<Detection, String>,
    lit: Lit,
}

/// Run it.
pub fn run(args: &Args, context: &Context) -> anyhow::Result<Ended> {
    let layout = BoardLayout::new(&args.board, args.square_mm).map_err(|error| UsageError(error.to_string()))?;
    let (report_path, plot_path) = (beside(&args.output, "_report.json"), beside(&args.output, "_report.png"));
    for path in [&args.output, &report_path, &plot_path].into_iter().chain(&args.corners_out) {
        context.refuse_overwriting(path)?;
    }
    let look = |image: &Image<Rgb8>| Looked {
        found: detect(image, &layout).ok_or_else(|| why_not(image, &layout)),
        lit: Lit::of(image),
    };
    let seen = look_at_all(&args.images, args.frames as usize, &context.console, &look)?;
    let size = same_size(&seen)?;
    let (with_board, without_board): (Vec<_>, Vec<_>) = seen.iter().partition(|seen| seen.found.found.is_ok());
    let without_board: Vec<NotFound> = (without_board.iter())
        .filter_map(|seen| {
            let why = seen.found.found.as_ref().err()?.clone();
            let name = seen.name.clone();
            Some(NotFound { name, why })
        })
        .collect();
    if with_board.len() < LEAST_VIEWS {
        let reasons: Vec<String> = (without_board.iter().take(3))
            .map(|picture| format!("{}: {}", picture.name, picture.why))
            .collect();
        return Err(CalibrationError::TooFewViews {
            found: with_board.len(),
            pictures: seen.len(),
            advice: format!(
                "{}{}take more, and see that the board is {} (a checkerboard counts inner corners) and not mirrored",
                reasons.join("; "),
                if reasons.is_empty() { "" } else { "; " },
                args.board
            ),
        }
        .into());
    }
    let found: Vec<(&str, &Detection)> = (with_board.iter())
        .filter_map(|seen| Some((seen.name.as_str(), seen.found.found.as_ref().ok()?)))
        .collect();
    let dot_radius_mm = median(found.iter().filter_map(|(_, detection)| detection.dot_radius_mm).collect());
    let views: Vec<View> = (found.iter())
        .map(|(_, detection)| View {
            corners: detection.corners.clone(),
            dot_radius_mm,
        })
        .collect();
    let calibration = calibrate(&views, size, args.model.lens())?;
    let difference = cross_validated(&views, size, args.model.lens(), &calibration);
    let circumstances = Circumstances {
        board: args.board.clone(),
        square_mm: args.square_mm,
        dot_radius_mm,
        names: found.iter().map(|(name, _)| (*name).to_owned()).collect(),
        namings: found.iter().map(|(_, detection)| detection.naming).collect(),
        without_board,
        lit: seen.iter().fold(Lit::default(), |lit, seen| lit.or(&seen.found.lit)),
    };
    let report = Report::new(&calibration, difference.as_ref(), &circumstances);
    if let Some(path) = &args.corners_out {
        write_json(
            path,
            &corners(&calibration, &circumstances.names, &args.board, args.square_mm),
        )?;
    }
    file::write(&args.output, &calibration.camera, "endofield")?;
    write_json(&report_path, &serde_json::to_value(&report)?)?;
    image_files::write(&plot_path, &plot::drawn(&calibration, difference.as_ref()))?;
    console::print(&report.table())?;
    say_written(&[&args.output, &report_path, &plot_path])?;
    Ok(Ended::Complete)
}

fn same_size<T>(seen: &[Seen<T>]) -> Result<(usize, usize), CalibrationError> {
    let tell = |seen: &Seen<T>| format!("{} ({}×{})", seen.name, seen.size.0, seen.size.1);
    let first = seen.first().ok_or(CalibrationError::Undetermined("there are no pictures"))?;
    match seen.iter().find(|other| other.size != first.size) {
        Some(other) => Err(CalibrationError::SizesDiffer {
            first: tell(first),
            other: tell(other),
        }),
        None => Ok(first.size),
    }
}

fn median(mut values: Vec<f64>) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied()
}

/// All corners as found and as used.
fn corners(calibration: &Calibration, names: &[String], board: &str, square_mm: f64) -> Value {
    let views: Vec<Value> = (calibration.views.iter().zip(names))
        .map(|(view, name)| {
            let corners: Vec<Value> = (view.residuals.iter())
                .map(|residual| {
                    let corner = &residual.corner;
                    json!({
                        "site": corner.site,
                        "board_mm": [corner.board.coords.x, corner.board.coords.y],
                        "pixel": [corner.pixel.x, corner.pixel.y],
                        "sigma_px": corner.sigma_px,
                        "error_px": residual.error_px,
                        "used": residual.used,
                    })
                })
                .collect();
            json!({ "name": name, "corners": corners })
        })
        .collect();
    json!({
        "board": board,
        "square_mm": square_mm,
        "image_size": [calibration.camera.width, calibration.camera.height],
        "views": views,
    })
}
