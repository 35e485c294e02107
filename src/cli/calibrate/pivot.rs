//! `calibrate pivot`: where the tip of a tracked pointer is.

use std::fmt::Write as _;
use std::path::PathBuf;

use serde::Serialize;

use crate::calibration::pivot::fit::{Outliers, Pivot, pivot};
use crate::calibration::pivot::plot;
use crate::cli::calibrate::pose_files;
use crate::cli::console;
use crate::cli::context::{Context, Ended};
use crate::geometry::space::{Hand, RobotBase};
use crate::geometry::transform::Transform;
use crate::media::image_files;

/// Find the tip of a tracked pointer from poses while it turned about it.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  endofield calibrate pivot pointer.tum
  endofield calibrate pivot poses/*.txt --leave-out-outliers -o pointer.json

Put the tip into a small hole, tilt the tool by 30° and more to all sides, and record its poses (the tracker's or the arm's).
Beside pivot.json is written pivot.png: where each pose puts the tip, and how far off that is.")]
pub struct Args {
    /// Poses of the tool: a TUM file, or 4×4 matrices, one a file.
    #[arg(required = true, value_name = "POSES")]
    poses: Vec<PathBuf>,
    /// Leave out poses that lie far off (more than six deviations) instead of only naming them.
    #[arg(long)]
    leave_out_outliers: bool,
    /// Result to write.
    #[arg(short, long, default_value = "pivot.json", value_name = "FILE")]
    output: PathBuf,
}

#[derive(Debug, Serialize)]
struct Report {
    version: &'static str,
    /// In the tool's space.
    tip_mm: [f64; 3],
    tip_sigma_mm: [f64; 3],
    /// Before the tracker.
    rest_mm: [f64; 3],
    rest_sigma_mm: [f64; 3],
    /// Along an axis.
    rms_mm: f64,
    poses: usize,
    outliers_left_out: bool,
    views: Vec<View>,
}

#[derive(Debug, Serialize)]
struct View {
    name: String,
    distance_mm: f64,
    offset_mm: [f64; 3],
    outlier: bool,
}

/// Run it.
pub fn run(args: &Args, context: &Context) -> anyhow::Result<Ended> {
    let plot_path = super::beside(&args.output, ".png");
    for path in [&args.output, &plot_path] {
        context.refuse_overwriting(path)?;
    }
    let named: Vec<(String, Transform<RobotBase, Hand>)> = pose_files::read(&args.poses)?;
    let (names, poses): (Vec<_>, Vec<_>) = named.into_iter().unzip();
    let outliers = if args.leave_out_outliers {
        Outliers::LeftOut
    } else {
        Outliers::Kept
    };
    let found = pivot(&poses, outliers)?;
    let report = Report::new(&found, names, args.leave_out_outliers);
    super::write_json(&args.output, &serde_json::to_value(&report)?)?;
    image_files::write(&plot_path, &plot::drawn(&found))?;
    console::print(&report.table())?;
    super::say_written(&[&args.output, &plot_path])?;
    Ok(Ended::Complete)
}

impl Report {
    fn new(found: &Pivot, names: Vec<String>, outliers_left_out: bool) -> Self {
        let deviations = |first: usize| [0, 1, 2].map(|i| found.covariance[(first + i, first + i)].max(0.0).sqrt());
        let seen = names.into_iter().zip(&found.offsets_mm).zip(&found.outliers);
        Self {
            version: env!("CARGO_PKG_VERSION"),
            tip_mm: found.tip.coords.into(),
            tip_sigma_mm: deviations(0),
            rest_mm: found.rest.coords.into(),
            rest_sigma_mm: deviations(3),
            rms_mm: found.rms_mm,
            poses: found.offsets_mm.len(),
            outliers_left_out,
            views: seen
                .map(|((name, offset), &outlier)| View {
                    name,
                    distance_mm: offset.norm(),
                    offset_mm: (*offset).into(),
                    outlier,
                })
                .collect(),
        }
    }

    fn table(&self) -> String {
        let of = |place: &[f64; 3], sigma: &[f64; 3]| {
            let [[x, y, z], [a, b, c]] = [place, sigma];
            format!("{x:.3} {y:.3} {z:.3} mm  (± {a:.3} {b:.3} {c:.3})")
        };
        let mut text = format!(
            "tip of the tool, {} poses\n  in the tool   {}\n  at rest at    {}\n  RMS along an axis {:.3} mm\n",
            self.poses,
            of(&self.tip_mm, &self.tip_sigma_mm),
            of(&self.rest_mm, &self.rest_sigma_mm),
            self.rms_mm
        );
        for view in self.views.iter().filter(|view| view.outlier) {
            let fate = if self.outliers_left_out {
                "left out"
            } else {
                "used nevertheless; --leave-out-outliers does without it"
            };
            let _ = writeln!(text, "  ! {}: its tip is {:.2} mm off ({fate})", view.name, view.distance_mm);
        }
        text
    }
}
