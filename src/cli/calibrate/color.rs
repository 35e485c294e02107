//! `calibrate color`: what a camera does to colors, from pictures of a chart, or its white balance from a white target.

use std::path::PathBuf;

use crate::calibration::color::chart::{self, COLUMNS, Edition, ROWS};
use crate::calibration::color::detection::{Found, NoChart, find, with_corners};
use crate::calibration::color::fit::calibrate;
use crate::calibration::color::patches::{Patch, measured};
use crate::calibration::color::plot;
use crate::calibration::color::report::{NotFound, PictureReport, Report};
use crate::calibration::homography;
use crate::camera::file;
use crate::camera::intrinsics::Pixel;
use crate::camera::model::CameraModel;
use crate::camera::undistortion;
use crate::cli::calibrate::color_white;
use crate::cli::calibrate::pictures::{Seen, look_at_all};
use crate::cli::console;
use crate::cli::context::{Context, Ended, UsageError};
use crate::image::buffer::{Image, Rgb8};
use crate::image::color_correction::Correction;
use crate::image::remap::Interpolation;
use crate::media::image_files;
use crate::stages::color_normalization::color_file::ColorFile;

/// More pictures of a chart tell no more, and take longer.
const MOST_PICTURES: usize = 12;

/// Measure what the camera does to colors.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  endofield calibrate color chart.png -o color.yaml
  endofield calibrate color chart.mp4 --camera camera.yaml --frames 6
  endofield calibrate color chart.png --corners 212,98 705,120 690,431 201,415
  endofield calibrate color white.png --white -o color.yaml

The chart is a ColorChecker Classic (24 patches in four rows of six), turned as you like, whole in the picture, in a light whose white is
not clipped. The light may fall off toward the border: it is measured with the colors. Beside color.yaml are written color_report.json
and color_report.png (the chart as found, and each patch as it should be, was, and is; of a white target, what it becomes and how far
from gray it stays from place to place). Put color.yaml into a recording's folder, and
`endofield process` applies it.")]
pub struct Args {
    /// Pictures of the chart or target, folders of pictures, videos or recordings.
    #[arg(required = true, value_name = "PICTURES")]
    pub(super) pictures: Vec<PathBuf>,
    /// Which chart.
    #[arg(long, value_enum, default_value_t = Chart::Colorchecker24)]
    chart: Chart,
    /// Middles of the chart's corner patches in the one picture: dark skin, bluish green, black, white.
    #[arg(
        long,
        num_args = 4,
        value_name = "X,Y",
        conflicts_with = "white",
        allow_hyphen_values = true
    )]
    corners: Vec<String>,
    /// The pictures show a white or gray target: white balance only.
    #[arg(long)]
    white: bool,
    /// The camera, to take its distortion off first.
    #[arg(long, value_name = "FILE")]
    camera: Option<PathBuf>,
    /// Frames looked at, of a recording or video.
    #[arg(long, default_value_t = 6, value_parser = clap::value_parser!(u32).range(1..=100))]
    pub(super) frames: u32,
    /// Color file to write; the reference in an existing one is kept.
    #[arg(short, long, default_value = "color.yaml", value_name = "FILE")]
    pub(super) output: PathBuf,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum Chart {
    /// ColorChecker Classic made since November 2014.
    Colorchecker24,
    /// ColorChecker Classic made before.
    #[value(name = "colorchecker24-2005")]
    Colorchecker24Before2014,
}

impl Chart {
    fn edition(self) -> Edition {
        match self {
            Self::Colorchecker24 => Edition::Since2014,
            Self::Colorchecker24Before2014 => Edition::Before2014,
        }
    }

    fn name(self) -> &'static str {
        match self {
            Self::Colorchecker24 => "ColorChecker Classic (since 2014)",
            Self::Colorchecker24Before2014 => "ColorChecker Classic (before 2014)",
        }
    }
}

/// A chart found, measured.
struct Looked {
    image: Image<Rgb8>,
    found: Found,
    patches: Vec<Patch>,
}

/// Run it.
pub fn run(args: &Args, context: &Context) -> anyhow::Result<Ended> {
    let report_path = super::beside(&args.output, "_report.json");
    let plot_path = super::beside(&args.output, "_report.png");
    for path in [&args.output, &report_path, &plot_path] {
        context.refuse_overwriting(path)?;
    }
    let camera = args.camera.as_deref().map(file::read).transpose()?;
    if args.white {
        return color_white::run(args, context, [&report_path, &plot_path]);
    }
    let corners = corners_of(args, camera.as_ref())?;
    let references = chart::references(args.chart.edition());
    let look = |image: &Image<Rgb8>| -> Result<Looked, String> {
        let image = match &camera {
            Some(camera) => undistorted(image, camera).map_err(|error| format!("{error:#}"))?,
            None => image.clone(),
        };
        let found = match corners {
            Some(corners) => with_corners(&image, corners, &references),
            None => find(&image, &references),
        };
        let found = found.map_err(|error: NoChart| error.to_string())?;
        let patches = measured(&image, &found.pixel_from_chart, 0).map_err(|error| error.to_string())?;
        Ok(Looked { image, found, patches })
    };
    let seen = look_at_all(&args.pictures, args.frames as usize, &context.console, &look)?;
    if corners.is_some() && seen.len() != 1 {
        return Err(UsageError(format!("expected one picture for --corners, found {}", seen.len())).into());
    }
    let (charts, without) = parted(seen);
    let Some((_, first)) = charts.first() else {
        // Most pictures fail for the same reason, which is told once.
        let mut reasons: Vec<(&str, Vec<&str>)> = Vec::new();
        for picture in &without {
            match reasons.iter_mut().find(|(why, _)| *why == picture.why) {
                Some((_, names)) => names.push(&picture.name),
                None => reasons.push((&picture.why, vec![&picture.name])),
            }
        }
        let reasons: Vec<String> = (reasons.iter().take(3))
            .map(|(why, names)| match names[..] {
                [name] => format!("{name}: {why}"),
                _ => format!("{} and {} more: {why}", names[0], names.len() - 1),
            })
            .collect();
        anyhow::bail!("{}", reasons.join("; "));
    };
    let patches: Vec<Patch> = (charts.iter().enumerate())
        .flat_map(|(picture, (_, looked))| looked.patches.iter().map(move |patch| Patch { picture, ..*patch }))
        .collect();
    let calibration = calibrate(&patches, charts.len(), &references)?;
    let pictures = charts
        .iter()
        .map(|(name, looked)| picture_report(name, &looked.found))
        .collect();
    let report = Report::new(&calibration, &references, args.chart.name(), pictures, without);
    write_color(args, calibration.correction.clone())?;
    super::write_json(&report_path, &serde_json::to_value(&report)?)?;
    let plot = plot::drawn(&report, &first.image, &first.found.pixel_from_chart);
    image_files::write(&plot_path, &plot)?;
    console::print(&report.table())?;
    super::say_written(&[&args.output, &report_path, &plot_path])?;
    Ok(Ended::Complete)
}

/// Those with a chart, the ones of best agreement but in their order, and those without.
fn parted(seen: Vec<Seen<Result<Looked, String>>>) -> (Vec<(String, Looked)>, Vec<NotFound>) {
    let (mut charts, mut without) = (Vec::new(), Vec::new());
    for seen in seen {
        match seen.found {
            Ok(looked) => charts.push((seen.name, looked)),
            Err(why) => without.push(NotFound { name: seen.name, why }),
        }
    }
    if charts.len() > MOST_PICTURES {
        let mut agreements: Vec<f64> = charts.iter().map(|(_, looked)| looked.found.agreement).collect();
        agreements.sort_by(|a, b| b.total_cmp(a));
        let least = agreements.get(MOST_PICTURES - 1).copied().unwrap_or(0.0);
        charts.retain(|(_, looked)| looked.found.agreement >= least);
        charts.truncate(MOST_PICTURES);
    }
    (charts, without)
}

fn picture_report(name: &str, found: &Found) -> PictureReport {
    let (right, low) = ((COLUMNS - 1) as f64, (ROWS - 1) as f64);
    let at = |place| homography::mapped(&found.pixel_from_chart, place).unwrap_or([f64::NAN; 2]);
    PictureReport {
        name: name.to_owned(),
        corners: [[0.0, 0.0], [right, 0.0], [right, low], [0.0, low]].map(at),
        patches_seen: found.patches_seen,
        agreement: found.agreement,
    }
}

/// The corners given, in the picture without distortion.
fn corners_of(args: &Args, camera: Option<&CameraModel>) -> anyhow::Result<Option<[Pixel; 4]>> {
    if args.corners.is_empty() {
        return Ok(None);
    }
    let wrong = |text: &str| UsageError(format!("expected a corner as X,Y in px, found `{text}`"));
    let mut corners = Vec::new();
    for text in &args.corners {
        let (x, y) = text.split_once(',').ok_or_else(|| wrong(text))?;
        let number = |part: &str| part.trim().parse::<f64>().ok().filter(|v| v.is_finite());
        let (Some(x), Some(y)) = (number(x), number(y)) else {
            return Err(wrong(text).into());
        };
        let mut corner = Pixel { x, y };
        if let Some(camera) = camera {
            let direction = camera.unproject(corner).ok_or_else(|| wrong(text))?;
            corner = camera
                .pinhole()
                .project(crate::geometry::point::Point::from_coords(direction.coords))
                .ok_or_else(|| wrong(text))?;
        }
        corners.push(corner);
    }
    Ok(Some(<[Pixel; 4]>::try_from(corners).map_err(|_| wrong("fewer than four"))?))
}

fn undistorted(image: &Image<Rgb8>, camera: &CameraModel) -> anyhow::Result<Image<Rgb8>> {
    let table = undistortion::table(camera, &camera.pinhole())?;
    let mut out = Image::filled(image.width(), image.height(), [0; 3]);
    table.remap_rgb(image, &mut out, Interpolation::Bilinear)?;
    Ok(out)
}

/// A file that is to be replaced keeps its reference colors: they are the tissue's, not the camera's.
pub(super) fn write_color(args: &Args, correction: Correction) -> anyhow::Result<()> {
    let reference = if args.output.exists() {
        ColorFile::read(&args.output).ok().and_then(|file| file.reference)
    } else {
        None
    };
    let color_file = ColorFile {
        reference,
        correction: Some(correction),
    };
    Ok(color_file.write(&args.output)?)
}
