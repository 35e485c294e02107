//! What `calibrate time-offset` tells a person and a machine.

use std::fmt::Write as _;

use serde::Serialize;

use crate::calibration::time_offset::offset::Offset;
use crate::calibration::time_offset::path_offset::{PathOffset, combined};
use crate::cli::calibrate::time_offset::ToldByPath;
use crate::time::Span;

/// Stretches that differ by more than so many times their deviations measured something else than a clock.
const MOST_SCATTER: f64 = 5.0;
/// Less sure than this is no answer, ms.
const MOST_SIGMA_MS: f64 = 10.0;
const MOVE_MORE: &str = "the motion does not tell the offset: record ten seconds in which the scope swings to and fro in several directions, not evenly";

/// A stretch of the recording through which the camera's path was found.
#[derive(Debug, Serialize)]
pub struct StretchReport {
    from_s: f64,
    to_s: f64,
    /// Pictures on the path.
    pub views: usize,
    /// Root mean square, of the pictures as they were looked at.
    pub reprojection_px: Option<f64>,
    time_offset_ms: Option<f64>,
    sigma_ms: Option<f64>,
    sure: bool,
    explained: Option<f64>,
    arm_noise_mm: Option<f64>,
    arm_noise_deg: Option<f64>,
    /// Why it told nothing.
    pub why_not: Option<String>,
}

impl StretchReport {
    /// Of a stretch that has told nothing yet.
    pub fn new([from_s, to_s]: [f64; 2]) -> Self {
        Self {
            from_s,
            to_s,
            views: 0,
            reprojection_px: None,
            time_offset_ms: None,
            sigma_ms: None,
            sure: false,
            explained: None,
            arm_noise_mm: None,
            arm_noise_deg: None,
            why_not: None,
        }
    }

    /// What its path told.
    pub fn tell(&mut self, offset: &PathOffset) {
        self.time_offset_ms = Some(offset.offset.milliseconds());
        self.sigma_ms = Some(offset.sigma_ms);
        self.sure = offset.is_sure();
        self.explained = Some(offset.explained);
        self.arm_noise_mm = Some(offset.arm_noise[0]);
        self.arm_noise_deg = Some(offset.arm_noise[1].to_degrees());
    }
}

/// What the motion of the picture as a whole told.
#[derive(Debug, Serialize)]
struct MotionReport {
    time_offset_ms: f64,
    sigma_ms: f64,
    sure: bool,
    explained: f64,
    distinctness: f64,
    window_s: f64,
    independent_windows: f64,
}

/// All of it.
#[derive(Debug, Serialize)]
pub struct Report {
    /// `camera path` or `image motion`.
    method: &'static str,
    /// Add to a pose stamp to get the camera's clock.
    pub time_offset_ms: Option<f64>,
    /// Standard deviation.
    pub sigma_ms: Option<f64>,
    /// Whether it may be relied on.
    pub sure: bool,
    /// What to do where it may not.
    pub advice: String,
    frames: usize,
    stretches: Vec<StretchReport>,
    image_motion: Option<MotionReport>,
    /// What the traces are.
    pub traced: &'static str,
    /// Offset (ms) and logarithm of its likelihood.
    pub curve: Vec<[f64; 2]>,
    /// Seconds, motion by the pictures, by the arm.
    pub traces: Vec<[f64; 3]>,
    /// Seconds into the recording, and what a look at the last seconds told.
    pub drift: Vec<(f64, String)>,
}

/// What the two ways told.
#[derive(Debug)]
pub struct Found {
    report: Report,
}

impl Found {
    /// The camera's path decides.
    pub fn by_path(told: Vec<ToldByPath>, by_motion: Option<Offset>, range: Span) -> Self {
        let sure: Vec<PathOffset> = told
            .iter()
            .filter_map(|(_, offset)| offset.clone())
            .filter(PathOffset::is_sure)
            .collect();
        let all: Vec<PathOffset> = told.iter().filter_map(|(_, offset)| offset.clone()).collect();
        let together = combined(if sure.is_empty() { &all } else { &sure });
        // Stretches that only say where the peak is flat say nothing.
        let is_sure = together.is_some_and(|found| {
            !sure.is_empty()
                && found.sigma_ms < MOST_SIGMA_MS
                && found.scatter < MOST_SCATTER
                && found.sigma_ms < 0.1 * range.milliseconds()
        });
        let advice = match together {
            _ if is_sure => String::new(),
            Some(found) if found.scatter >= MOST_SCATTER => {
                "stretches of the recording tell different offsets: a clock drifts or jumps, or the tissue moves by itself"
                    .to_owned()
            }
            Some(_) => MOVE_MORE.to_owned(),
            None => {
                let first = told.iter().find_map(|(report, _)| report.why_not.clone());
                first.unwrap_or_else(|| "the recording is too short".to_owned())
            }
        };
        let (mut curve, mut traces) = (Vec::new(), Vec::new());
        for (report, offset) in &told {
            let Some(offset) = offset.as_ref().filter(|offset| sure.is_empty() || offset.is_sure()) else {
                continue;
            };
            if curve.is_empty() {
                curve = offset.curve.clone();
            } else {
                sum_where_both(&mut curve, &offset.curve);
            }
            traces.extend(
                offset
                    .traces
                    .iter()
                    .map(|[s, picture, arm]| [s + report.from_s, *picture, *arm]),
            );
        }
        Self {
            report: Report {
                method: "camera path",
                time_offset_ms: together.map(|found| found.offset.milliseconds()),
                sigma_ms: together.map(|found| found.sigma_ms),
                sure: is_sure,
                advice,
                frames: 0,
                stretches: told.into_iter().map(|(report, _)| report).collect(),
                image_motion: by_motion.as_ref().map(MotionReport::of),
                traced: "HAND MM",
                curve,
                traces,
                drift: Vec::new(),
            },
        }
    }

    /// Only the motion of the picture is known.
    pub fn by_motion(found: Offset) -> Self {
        Self {
            report: Report {
                method: "image motion",
                time_offset_ms: Some(found.offset.milliseconds()),
                sigma_ms: Some(found.sigma_ms),
                sure: found.is_sure(),
                advice: if found.is_sure() {
                    String::new()
                } else {
                    MOVE_MORE.to_owned()
                },
                frames: 0,
                stretches: Vec::new(),
                image_motion: Some(MotionReport::of(&found)),
                traced: "MOTION",
                curve: found.curve,
                traces: found.traces,
                drift: Vec::new(),
            },
        }
    }

    /// As a report on so many frames.
    pub fn report(self, frames: usize) -> Report {
        Report { frames, ..self.report }
    }
}

fn sum_where_both(curve: &mut Vec<[f64; 2]>, other: &[[f64; 2]]) {
    curve.retain_mut(|[ms, likelihood]| {
        let same = other.iter().find(|[other_ms, _]| (other_ms - *ms).abs() < 1e-6);
        if let Some([_, more]) = same {
            *likelihood += more;
        }
        same.is_some()
    });
}

impl MotionReport {
    fn of(found: &Offset) -> Self {
        Self {
            time_offset_ms: found.offset.milliseconds(),
            sigma_ms: found.sigma_ms,
            sure: found.is_sure(),
            explained: found.explained,
            distinctness: found.distinctness,
            window_s: found.windows[0],
            independent_windows: found.windows[1],
        }
    }
}

/// Rows and columns of the likelihood's plot on the terminal.
const PLOT_ROWS: usize = 8;
const PLOT_COLUMNS: usize = 61;
/// Likelihoods lower than the best by more than this are the floor of the terminal's plot.
const DEEPEST: f64 = 200.0;

impl Report {
    /// The offset that the recording begins with, as far as it is sure: what a live line would believe.
    pub fn believed_ms(&self) -> Option<f64> {
        let first = self.stretches.iter().find(|stretch| stretch.sure);
        first.map_or(self.time_offset_ms.filter(|_| self.sure), |stretch| stretch.time_offset_ms)
    }

    /// For a person.
    pub fn table(&self) -> String {
        let mut text = String::new();
        // Writing to a String cannot fail.
        let _ = match (self.time_offset_ms, self.sigma_ms) {
            (Some(offset_ms), Some(sigma_ms)) => writeln!(
                text,
                "time offset   {offset_ms:.1} ms (± {sigma_ms:.1}): to be added to the arm's stamps{}\n  told by {} of {} frames",
                if self.sure { "" } else { "; NOT SURE" },
                if self.method == "image motion" {
                    "the motion of the whole picture"
                } else {
                    "the camera's path through the pictures"
                },
                self.frames
            ),
            _ => writeln!(text, "time offset   not observed, of {} frames", self.frames),
        };
        for stretch in &self.stretches {
            let _ = write!(text, "  {:6.1} to {:5.1} s  ", stretch.from_s, stretch.to_s);
            let _ = match (stretch.time_offset_ms, stretch.sigma_ms, &stretch.why_not) {
                (Some(offset_ms), Some(sigma_ms), _) => writeln!(
                    text,
                    "{offset_ms:7.1} ms ± {sigma_ms:<5.1} {} views, {:.2} px; the arm errs by {:.2} mm, {:.3}° per reading",
                    stretch.views,
                    stretch.reprojection_px.unwrap_or(f64::NAN),
                    stretch.arm_noise_mm.unwrap_or(f64::NAN),
                    stretch.arm_noise_deg.unwrap_or(f64::NAN)
                ),
                (.., why) => writeln!(text, "{}", why.as_deref().unwrap_or("told nothing")),
            };
        }
        if let Some(motion) = &self.image_motion {
            let _ = writeln!(
                text,
                "  {}motion of the whole picture: {:.1} ms ± {:.1}, {:.0} % explained by the arm's, {:.0} independent windows of {:.1} s{}",
                if self.stretches.is_empty() { "" } else { "for comparison, " },
                motion.time_offset_ms,
                motion.sigma_ms,
                100.0 * motion.explained,
                motion.independent_windows,
                motion.window_s,
                if motion.sure { "" } else { "; not sure" },
            );
        }
        text.push_str(&plot(&self.curve));
        if !self.drift.is_empty() {
            let count = |what: &str| self.drift.iter().filter(|(_, verdict)| verdict.starts_with(what)).count();
            let (agree, drifted) = (count("agree"), count("drifted"));
            let _ = writeln!(
                text,
                "  looks at the last seconds: {agree} agree, {drifted} found the clocks apart, {} saw too little motion to tell",
                self.drift.len() - agree - drifted
            );
        }
        for (at, verdict) in self.drift.iter().filter(|(_, verdict)| verdict.starts_with("drifted")) {
            let _ = writeln!(text, "  ! at {at:.0} s the clocks have {verdict}");
        }
        text
    }
}

/// The likelihood over the offset, as columns.
fn plot(curve: &[[f64; 2]]) -> String {
    let (Some(first), Some(last)) = (curve.first(), curve.last()) else {
        return String::new();
    };
    let high = curve.iter().map(|[_, l]| *l).fold(f64::NEG_INFINITY, f64::max);
    let low = curve
        .iter()
        .map(|[_, l]| *l)
        .fold(f64::INFINITY, f64::min)
        .max(high - DEEPEST);
    let columns: Vec<usize> = (0..PLOT_COLUMNS)
        .map(|column| {
            let [_, likelihood] = curve[column * (curve.len() - 1) / (PLOT_COLUMNS - 1)];
            ((likelihood.max(low) - low) / (high - low).max(1e-12) * PLOT_ROWS as f64).round() as usize
        })
        .collect();
    let mut text = String::new();
    for row in (1..=PLOT_ROWS).rev() {
        let line: String = columns.iter().map(|&height| if height >= row { '#' } else { ' ' }).collect();
        let _ = writeln!(text, "  |{}", line.trim_end());
    }
    let _ = writeln!(text, "  {:<30.0}log-likelihood{:>18.0} ms", first[0], last[0]);
    text
}
