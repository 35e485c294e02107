//! `calibrate oblique`: the joint between camera head and telescope, from a board seen at several rotations.
//!
//! A command of its own and not an option of `calibrate camera`: it needs to know which pictures were taken with head and board at rest,
//! and at which rotation, and what it finds is a joint, not a camera.

use std::path::{Path, PathBuf};

use anyhow::Context as _;

use crate::calibration::board::detection::{Detection, detect, why_not};
use crate::calibration::board::pattern::BoardLayout;
use crate::calibration::board::placement::Naming;
use crate::calibration::camera::lens::LensModel;
use crate::calibration::oblique::joint::{Angles, Sighting};
use crate::calibration::oblique::plot;
use crate::calibration::oblique::refine::calibrate;
use crate::calibration::oblique::report::{Names, Report};
use crate::camera::file;
use crate::cli::calibrate::pictures::look_at_all;
use crate::cli::console;
use crate::cli::context::{Context, Ended, UsageError};
use crate::media::image_files;

/// A board of fewer corners tells too little.
const LEAST_CORNERS: usize = 8;

/// Measure how an oblique telescope turns against its camera head.
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:
  endofield calibrate oblique views.csv --board checkerboard:9x6 --square-mm 4 -o camera.yaml

views.csv has a line for each picture; pictures lie beside it:
  picture,station,rotation,angle_deg
  a0.png,a,start,0
  a1.png,a,left,
  b0.png,b,start,0

At a station, head and board rest while the telescope is turned (by 20° to 90° in all, as far as the board stays in view); at the next
one the board lies otherwise. The telescope is turned alike in all pictures of a rotation. The first rotation wants pictures at eight
stations, each other one at two or more. angle_deg may be left out, for some or all: then angles are measured from the first rotation,
positive where the picture turns clockwise. rotation may be left out where angle_deg is given.

camera.yaml holds the camera at angle 0 as any camera file does, and a block `oblique` for the joint, which other readers pass over.
Beside it are written camera_report.json, with covariance, and camera_report.png: what is left of each corner, and how well each picture
fits.")]
pub struct Args {
    /// The list of pictures.
    #[arg(value_name = "CSV")]
    views: PathBuf,
    /// The board, such as checkerboard:9x6 (as in calibrate camera).
    #[arg(long)]
    board: String,
    /// Side of a square, mm.
    #[arg(long, value_name = "MM")]
    square_mm: f64,
    /// Lens model.
    #[arg(long, value_enum, default_value_t = super::camera::Model::PlumbBob)]
    model: super::camera::Model,
    /// How well the angles given are known, degrees.
    #[arg(long, value_name = "DEG", default_value_t = 0.25)]
    angle_sigma_deg: f64,
    /// Camera file to write.
    #[arg(short, long, default_value = "camera.yaml", value_name = "FILE")]
    output: PathBuf,
}

/// A line of the list.
#[derive(Clone, Debug, PartialEq)]
struct Line {
    picture: String,
    station: usize,
    rotation: usize,
}

/// The list, names by number.
#[derive(Clone, Debug, Default, PartialEq)]
struct Views {
    lines: Vec<Line>,
    stations: Vec<String>,
    rotations: Vec<String>,
    angles_deg: Vec<Option<f64>>,
}

/// Run it.
pub fn run(args: &Args, context: &Context) -> anyhow::Result<Ended> {
    let layout = BoardLayout::new(&args.board, args.square_mm).map_err(|error| UsageError(error.to_string()))?;
    if layout.looks_the_same_upside_down() {
        return Err(UsageError(format!(
            "expected a board that tells its orientation, found {}: it looks the same upside down, and a telescope may turn by half; use one of \
             odd and even numbers of corners, or a ChArUco board",
            args.board
        ))
        .into());
    }
    if !(args.angle_sigma_deg > 0.0 && args.angle_sigma_deg.is_finite()) {
        return Err(UsageError(format!(
            "expected a positive --angle-sigma-deg, found {}",
            args.angle_sigma_deg
        ))
        .into());
    }
    let report_path = super::beside(&args.output, "_report.json");
    let plot_path = super::beside(&args.output, "_report.png");
    for path in [&args.output, &report_path, &plot_path] {
        context.refuse_overwriting(path)?;
    }
    anyhow::ensure!(
        !args.views.is_dir(),
        "{}: expected a list of pictures (CSV), found a folder; `endofield calibrate oblique --help` shows such a list",
        args.views.display()
    );
    let text = std::fs::read_to_string(&args.views).with_context(|| format!("{}: cannot be read", args.views.display()))?;
    let views = parsed(&text).map_err(|what| anyhow::anyhow!("{}: {what}", args.views.display()))?;
    let folder = args.views.parent().unwrap_or(Path::new(""));
    let paths: Vec<PathBuf> = views.lines.iter().map(|line| folder.join(&line.picture)).collect();
    let seen = look_at_all(&paths, 1, &context.console, &|image| -> Result<Detection, String> {
        detect(image, &layout).ok_or_else(|| why_not(image, &layout))
    })?;
    anyhow::ensure!(
        seen.len() == views.lines.len(),
        "expected a picture file in each line of {}, found {} pictures for {} lines",
        args.views.display(),
        seen.len(),
        views.lines.len()
    );
    let size = seen.first().map_or((0, 0), |seen| seen.size);
    if let Some(other) = seen.iter().find(|other| other.size != size) {
        anyhow::bail!(
            "expected pictures of one size, {}×{}, found {} of {}×{}",
            size.0,
            size.1,
            other.name,
            other.size.0,
            other.size.1
        );
    }
    let (mut sightings, mut pictures, mut without) = (Vec::new(), Vec::new(), Vec::new());
    for (seen, line) in seen.iter().zip(&views.lines) {
        match &seen.found {
            // Which corners of the board these are would be a guess, and another one in the next picture.
            Ok(detection) if detection.naming == Naming::Shifted => {
                without.push(format!(
                    "{}: only a part of the board, which one is not known (a ChArUco board tells)",
                    line.picture
                ));
            }
            Ok(detection) if detection.corners.len() >= LEAST_CORNERS => {
                sightings.push(Sighting {
                    station: line.station,
                    rotation: line.rotation,
                    corners: detection.corners.clone(),
                });
                pictures.push(line.picture.clone());
            }
            Ok(detection) => without.push(format!("{}: only {} corners", line.picture, detection.corners.len())),
            Err(why) => without.push(format!("{}: {why}", line.picture)),
        }
    }
    anyhow::ensure!(
        !sightings.is_empty(),
        "expected the board in the pictures, found it in none of {}; {}",
        without.len(),
        without.iter().take(3).cloned().collect::<Vec<_>>().join("; ")
    );
    let angles = Angles {
        given_rad: views.angles_deg.iter().map(|angle| angle.map(f64::to_radians)).collect(),
        sigma_rad: args.angle_sigma_deg.to_radians(),
    };
    let stations = with_pictures(&mut sightings, views.stations);
    let model: LensModel = args.model.lens();
    let calibration = calibrate(&sightings, &angles, size, model)?;
    let names = Names {
        rotations: views.rotations,
        stations,
        pictures,
    };
    let report = Report::new(&calibration, &sightings, &angles.given_rad, &names, without);
    file::write_oblique(&args.output, &calibration.camera, &calibration.oblique, "endofield")?;
    super::write_json(&report_path, &serde_json::to_value(&report)?)?;
    image_files::write(&plot_path, &plot::drawn(&calibration, &report))?;
    console::print(&report.table())?;
    super::say_written(&[&args.output, &report_path, &plot_path])?;
    Ok(Ended::Complete)
}

/// Stations at which no board was found fall out: numbers are those of the stations left, whose names are given back.
fn with_pictures(sightings: &mut [Sighting], names: Vec<String>) -> Vec<String> {
    let mut places = vec![None; names.len()];
    let mut kept = Vec::new();
    for sighting in sightings {
        if let Some(place) = places.get_mut(sighting.station) {
            let name = names.get(sighting.station).cloned().unwrap_or_default();
            sighting.station = *place.get_or_insert_with(|| {
                kept.push(name);
                kept.len() - 1
            });
        }
    }
    kept
}

fn parsed(text: &str) -> Result<Views, String> {
    let mut lines = (text.lines().enumerate())
        .map(|(number, line)| (number + 1, line.trim()))
        .filter(|(_, line)| !line.is_empty() && !line.starts_with('#'));
    let header = lines
        .next()
        .ok_or("expected a header such as picture,station,rotation,angle_deg, found nothing")?
        .1;
    let columns: Vec<&str> = header.split(',').map(str::trim).collect();
    let place = |name: &str| columns.iter().position(|column| *column == name);
    let (Some(picture), Some(station)) = (place("picture"), place("station")) else {
        return Err(format!(
            "expected the columns picture and station, and rotation or angle_deg, found `{header}`"
        ));
    };
    let (rotation, angle) = (place("rotation"), place("angle_deg"));
    if rotation.is_none() && angle.is_none() {
        return Err(format!("expected a column rotation or angle_deg, found `{header}`"));
    }
    let mut views = Views::default();
    for (number, line) in lines {
        let fields: Vec<&str> = line.split(',').map(str::trim).collect();
        let field = |place: Option<usize>| {
            place
                .and_then(|place| fields.get(place))
                .copied()
                .filter(|field| !field.is_empty())
        };
        let (Some(picture), Some(station)) = (field(Some(picture)), field(Some(station))) else {
            return Err(format!("line {number}: expected {} fields, found `{line}`", columns.len()));
        };
        let degrees = match field(angle) {
            None => None,
            Some(text) => match text.parse::<f64>() {
                Ok(degrees) if degrees.is_finite() => Some(degrees),
                _ => return Err(format!("line {number}: expected an angle in degrees, found `{text}`")),
            },
        };
        let Some(name) = field(rotation).or(field(angle)) else {
            return Err(format!("line {number}: expected a rotation's name or angle, found neither"));
        };
        let rotation = numbered(&mut views.rotations, name);
        if rotation == views.angles_deg.len() {
            views.angles_deg.push(degrees);
        } else if let (Some(known), Some(told)) = (views.angles_deg.get_mut(rotation), degrees) {
            if known.is_some_and(|known| known != told) {
                return Err(format!(
                    "line {number}: the rotation `{name}` is at {told}°, and before at another angle"
                ));
            }
            *known = Some(told);
        }
        let station = numbered(&mut views.stations, station);
        views.lines.push(Line {
            picture: picture.to_owned(),
            station,
            rotation,
        });
    }
    Ok(views)
}

/// The number of a name, new ones being added.
fn numbered(names: &mut Vec<String>, name: &str) -> usize {
    names.iter().position(|known| known == name).unwrap_or_else(|| {
        names.push(name.to_owned());
        names.len() - 1
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lists_are_read_and_their_faults_named() {
        let views = parsed("picture,station,angle_deg\na.png,1,0\nb.png,1,30\n# all again\nc.png,2,0\n").unwrap();
        assert_eq!(views.angles_deg, [Some(0.0), Some(30.0)]);
        assert_eq!(
            views.lines[2],
            Line {
                picture: "c.png".into(),
                station: 1,
                rotation: 0
            }
        );
        let views = parsed("picture,station,rotation,angle_deg\na.png,1,x,\nb.png,1,y,30\nc.png,2,x,5\n").unwrap();
        assert_eq!((views.rotations.len(), views.angles_deg), (2, vec![Some(5.0), Some(30.0)]));
        for (text, word) in [
            ("", "header"),
            ("picture,angle_deg\n", "station"),
            ("picture,station\n", "rotation or angle_deg"),
            ("picture,station,rotation\na.png\n", "line 2"),
            ("picture,station,angle_deg\na.png,1,left\n", "degrees"),
            (
                "picture,station,rotation,angle_deg\na.png,1,x,3\nb.png,2,x,4\n",
                "another angle",
            ),
        ] {
            let error = parsed(text).unwrap_err();
            assert!(error.contains(word), "`{text}` gives `{error}`");
        }
    }
}
