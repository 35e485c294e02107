//! What a calibration of colors tells its user: a table for people, JSON for machines.

use std::fmt::Write as _;

use serde::Serialize;

use crate::calibration::color::chart::{NAMES, PATCHES, Reference};
use crate::calibration::color::fit::Calibration;
use crate::image::color::srgb_from_linear;
use crate::image::color_correction::Formula;

/// Above this mean ΔE the correction is doubtful.
const DOUBTFUL: f64 = 4.0;
/// Colors agree at least so well when corners are given and right.
const LEAST_AGREEMENT: f64 = 0.75;

/// A patch, mean over the pictures.
#[derive(Clone, Debug, Serialize)]
pub struct PatchReport {
    /// Of the patch.
    pub name: &'static str,
    /// As seen, 8-bit sRGB levels, the light on the chart evened out.
    pub measured: [f64; 3],
    /// Corrected.
    pub corrected: [f64; 3],
    /// The right ones; beyond 0 to 255 where sRGB does not reach.
    pub reference: [f64; 3],
    /// ΔE2000 of the picture as it is, light uneven.
    pub as_seen: f64,
    /// ΔE2000 before correction, light evened out.
    pub before: f64,
    /// ΔE2000 after it.
    pub after: f64,
    /// Light on it, relative to the chart's middle.
    pub light: f64,
    /// Clipped or black in every picture: not used.
    pub out_of_range: bool,
}

/// Mean, median and largest ΔE2000 of the patches in range.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct Errors {
    /// Mean.
    pub mean: f64,
    /// Median.
    pub median: f64,
    /// Largest.
    pub max: f64,
}

impl Errors {
    fn of(values: impl Iterator<Item = f64>) -> Self {
        let mut sorted: Vec<f64> = values.collect();
        sorted.sort_by(f64::total_cmp);
        let n = sorted.len().max(1);
        Self {
            mean: sorted.iter().sum::<f64>() / n as f64,
            median: sorted.get(n / 2).copied().unwrap_or(0.0),
            max: sorted.last().copied().unwrap_or(0.0),
        }
    }
}

/// A form of correction that was tried.
#[derive(Clone, Debug, Serialize)]
pub struct TrialReport {
    /// Form.
    pub form: &'static str,
    /// Numbers it has.
    pub numbers: usize,
    /// Mean ΔE2000 on patches left out.
    pub cross_validated: f64,
    /// The one taken.
    pub chosen: bool,
}

/// A picture with a chart.
#[derive(Clone, Debug, Serialize)]
pub struct PictureReport {
    /// File or frame.
    pub name: String,
    /// Middles of dark skin, bluish green, black and white, px.
    pub corners: [[f64; 2]; 4],
    /// Patches seen as even areas; 0 if the corners were given.
    pub patches_seen: usize,
    /// Share of the colors' variation that the chart explains.
    pub agreement: f64,
}

/// A picture without one.
#[derive(Clone, Debug, Serialize)]
pub struct NotFound {
    /// File or frame.
    pub name: String,
    /// What was expected, found, and to do.
    pub why: String,
}

/// All that is told.
#[derive(Clone, Debug, Serialize)]
pub struct Report {
    /// Version of the program.
    pub version: &'static str,
    /// Of the chart.
    pub chart: String,
    /// Form of the correction.
    pub form: &'static str,
    /// Exponent of the encoded values.
    pub gamma: f64,
    /// Degree of the polynomial that the light's logarithm is.
    pub light_degree: usize,
    /// Least over most light on the chart, first picture.
    pub light_range: f64,
    /// ΔE2000 of the picture as it is.
    pub as_seen: Errors,
    /// ΔE2000 before, light evened out.
    pub before: Errors,
    /// ΔE2000 after.
    pub after: Errors,
    /// Mean ΔE2000 of patches predicted from the others.
    pub cross_validated: f64,
    /// All forms tried.
    pub trials: Vec<TrialReport>,
    /// The patches.
    pub patches: Vec<PatchReport>,
    /// Pictures with a chart.
    pub pictures: Vec<PictureReport>,
    /// Pictures without.
    pub without_chart: Vec<NotFound>,
    /// What to mend.
    pub warnings: Vec<String>,
}

impl Report {
    /// Of a calibration.
    pub fn new(
        calibration: &Calibration,
        references: &[Reference; PATCHES],
        chart: &str,
        pictures: Vec<PictureReport>,
        without_chart: Vec<NotFound>,
    ) -> Self {
        let patches: Vec<PatchReport> = (0..PATCHES)
            .filter_map(|patch| patch_report(calibration, references, patch))
            .collect();
        let lights = || {
            let first = calibration.patches.iter().filter(|p| p.patch.picture == 0);
            first.map(|p| p.light)
        };
        let (least, most) = (lights().fold(f64::INFINITY, f64::min), lights().fold(0.0, f64::max));
        let in_range = || patches.iter().filter(|patch| !patch.out_of_range);
        let after = Errors::of(in_range().map(|patch| patch.after));
        let warnings = warnings(&patches, after.mean, calibration, &pictures, least / most);
        Self {
            version: env!("CARGO_PKG_VERSION"),
            chart: chart.to_owned(),
            form: calibration.shape.name(),
            gamma: calibration.correction.gamma[0],
            light_degree: calibration.light_degree,
            light_range: least / most,
            as_seen: Errors::of(in_range().map(|patch| patch.as_seen)),
            before: Errors::of(in_range().map(|patch| patch.before)),
            after,
            cross_validated: calibration.cross_validated(),
            trials: (calibration.trials.iter().enumerate())
                .map(|(place, trial)| TrialReport {
                    form: trial.shape.name(),
                    numbers: trial.shape.numbers(),
                    cross_validated: trial.mean(),
                    chosen: place == calibration.chosen,
                })
                .collect(),
            patches,
            pictures,
            without_chart,
            warnings,
        }
    }

    /// As a table for a terminal.
    pub fn table(&self) -> String {
        let mut text = String::new();
        // Writing to a String cannot fail.
        let _ = writeln!(
            text,
            "colors by {} in {} picture{}\n  correction       {}{}\n  light            falls to {:.0} % on the chart (degree {})\n",
            self.chart,
            self.pictures.len(),
            if self.pictures.len() == 1 { "" } else { "s" },
            self.form,
            if self.gamma == 1.0 {
                String::new()
            } else {
                format!(" {:.3}", self.gamma)
            },
            100.0 * self.light_range,
            self.light_degree,
        );
        let _ = writeln!(
            text,
            "  {:<15}{:>14}{:>14}{:>14}{:>9}{:>8}{:>8}",
            "patch", "measured", "corrected", "reference", "as seen", "before", "after"
        );
        let levels = |color: &[f64; 3]| color.map(|v| format!("{v:>4.0}")).concat();
        for patch in &self.patches {
            let _ = writeln!(
                text,
                "  {:<15}{:>14}{:>14}{:>14}{:>9.2}{:>8.2}{:>8.2}{}",
                patch.name,
                levels(&patch.measured),
                levels(&patch.corrected),
                levels(&patch.reference),
                patch.as_seen,
                patch.before,
                patch.after,
                if patch.out_of_range { "  out of range, not used" } else { "" },
            );
        }
        text.push('\n');
        for (name, pick) in [
            ("mean ΔE2000", (|e: &Errors| e.mean) as fn(&Errors) -> f64),
            ("median", |e| e.median),
            ("max", |e| e.max),
        ] {
            let _ = writeln!(
                text,
                "  {name:<15}{:>51.2}{:>8.2}{:>8.2}",
                pick(&self.as_seen),
                pick(&self.before),
                pick(&self.after)
            );
        }
        let _ = writeln!(
            text,
            "  {:<15}{:>67.2}\n\n  as seen: the picture as it is; before, after: the light on the chart evened out\n\n  form tried                numbers   cross-validated",
            "left-out patches", self.cross_validated
        );
        for trial in &self.trials {
            let _ = writeln!(
                text,
                "  {:<26}{:>7}{:>18.2}{}",
                trial.form,
                trial.numbers,
                trial.cross_validated,
                if trial.chosen { "  taken" } else { "" }
            );
        }
        for picture in &self.without_chart {
            let _ = writeln!(text, "  no chart in {}: {}", picture.name, picture.why);
        }
        for warning in &self.warnings {
            let _ = writeln!(text, "  warning: {warning}");
        }
        text
    }
}

/// 8-bit levels, going on straight below 0.
pub fn levels_from_linear(linear: [f64; 3]) -> [f64; 3] {
    linear.map(|v| 255.0 * srgb_from_linear(v))
}

fn patch_report(calibration: &Calibration, references: &[Reference; PATCHES], patch: usize) -> Option<PatchReport> {
    let all: Vec<_> = calibration.patches.iter().filter(|p| p.patch.patch == patch).collect();
    let good: Vec<_> = all.iter().filter(|p| !p.patch.out_of_range).copied().collect();
    let out_of_range = good.is_empty();
    let shown = if out_of_range { all } else { good };
    let n = shown.len() as f64;
    let mean =
        |pick: &dyn Fn(&crate::calibration::color::fit::PatchResult) -> f64| shown.iter().map(|p| pick(p)).sum::<f64>() / n;
    let evened = |channel: usize| mean(&|p| p.patch.linear[channel] / p.light);
    (n > 0.0).then(|| PatchReport {
        name: NAMES[patch],
        measured: levels_from_linear(std::array::from_fn(evened)).map(|v| v.min(255.0)),
        corrected: levels_from_linear(std::array::from_fn(|c| mean(&|p| p.corrected[c]))).map(|v| v.clamp(0.0, 255.0)),
        reference: levels_from_linear(references[patch].linear),
        as_seen: mean(&|p| p.seen_error),
        before: mean(&|p| p.before),
        after: mean(&|p| p.after),
        light: mean(&|p| p.light),
        out_of_range,
    })
}

fn warnings(
    patches: &[PatchReport],
    after: f64,
    calibration: &Calibration,
    pictures: &[PictureReport],
    light_range: f64,
) -> Vec<String> {
    let mut warnings = Vec::new();
    let lost: Vec<&str> = patches.iter().filter(|p| p.out_of_range).map(|p| p.name).collect();
    if !lost.is_empty() {
        warnings.push(format!(
            "clipped or black, not used: {}; change light or exposure",
            lost.join(", ")
        ));
    }
    if after > DOUBTFUL {
        warnings.push(format!(
            "ΔE {after:.1} stays after correction: is it this chart (--chart), clean, and lit by one kind of light?"
        ));
    }
    let cross = calibration.cross_validated();
    if cross > 2.0 * after.max(0.5) {
        warnings.push(format!(
            "patches left out of the fit are off by ΔE {cross:.1}: more pictures of the chart would help"
        ));
    }
    for picture in pictures.iter().filter(|p| p.agreement < LEAST_AGREEMENT) {
        warnings.push(format!(
            "{}: the colors agree by only {:.2} with the chart's: are the corners in the order dark skin, bluish green, black, white?",
            picture.name, picture.agreement
        ));
    }
    if light_range < 0.25 {
        warnings.push(format!(
            "the light falls to {:.0} % on the chart: bring the chart nearer to the picture's middle, or farther away",
            100.0 * light_range
        ));
    }
    if matches!(calibration.correction.formula, Formula::Polynomial { .. }) {
        warnings
            .push("a polynomial holds at the chart's brightness; darker and brighter tissue is corrected less surely".to_owned());
    }
    warnings
}
