//! `calibrate color --white`: the white balance, from pictures of a white or gray target.

use std::path::Path;

use serde_json::json;

use crate::calibration::color::report::levels_from_linear;
use crate::calibration::color::white::White;
use crate::calibration::color::white_plot;
use crate::cli::calibrate::color::{Args, write_color};
use crate::cli::calibrate::pictures::look_at_all;
use crate::cli::console;
use crate::cli::context::{Context, Ended};
use crate::image::buffer::{Image, Rgb8};
use crate::media::image_files;

/// Larger differences to gray from place to place are no matter of white balance, ΔE2000.
const WHITE_LOCAL: f64 = 3.0;

/// Measure it and write it.
pub fn run(args: &Args, context: &Context, [report_path, plot_path]: [&Path; 2]) -> anyhow::Result<Ended> {
    let seen = look_at_all(&args.pictures, args.frames as usize, &context.console, &Image::clone)?;
    let images: Vec<&Image<Rgb8>> = seen.iter().map(|seen| &seen.found).collect();
    let white = White::measured(&images)?;
    write_color(args, white.correction())?;
    let levels = |linear: [f64; 3]| levels_from_linear(linear).map(|v| (v * 10.0).round() / 10.0);
    let corrected: [f64; 3] = std::array::from_fn(|c| white.seen[c] * white.gains[c]);
    super::write_json(
        report_path,
        &json!({
            "version": env!("CARGO_PKG_VERSION"),
            "target": "white or gray",
            "pictures": seen.iter().map(|seen| seen.name.as_str()).collect::<Vec<_>>(),
            "gains": white.gains,
            "share_of_picture": white.share,
            "spread": white.spread,
            "seen": levels(white.seen),
            "corrected": levels(corrected),
            "delta_e_2000_to_gray": { "before": white.before, "after": white.after, "after_mean_of_tenths": white.after_local },
            "after_tenths": white.after_tenths,
        }),
    )?;
    // The target in the first picture; there is one, or nothing would have been measured.
    if let Some(first) = images.first() {
        image_files::write(plot_path, &white_plot::drawn(&white, first))?;
    }
    let mut text = format!(
        "white balance by {} picture{}, {:.0} % of them neither dark nor clipped\n  gains            red {:.4}  green {:.4}  blue {:.4}  (linear light)\n",
        seen.len(),
        if seen.len() == 1 { "" } else { "s" },
        100.0 * white.share,
        white.gains[0],
        white.gains[1],
        white.gains[2]
    );
    text += &format!(
        "  mean color       {:?} becomes {:?}\n  \u{394}E2000 to gray   {:.2} before, {:.2} after; {:.2} after in tenths of the picture, mean\n",
        levels(white.seen),
        levels(corrected),
        white.before,
        white.after,
        white.after_local
    );
    if white.after_local > WHITE_LOCAL {
        text += "  warning: the target's color changes over the picture; is other light in the room on it?\n";
    }
    console::print(&text)?;
    super::say_written(&[&args.output, report_path, plot_path])?;
    Ok(Ended::Complete)
}
