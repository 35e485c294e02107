//! `demo`: everything once, without hardware, against known truth.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use anyhow::{Context as _, bail};
use serde::Serialize;

use crate::cli::console;
use crate::cli::context::{Context, Ended};
use crate::cli::light_field;
use crate::cli::measure::{MeasureSink, Measured, before_after};
use crate::cli::process::{self, process};
use crate::cli::report::Report;
use crate::compose::Choice;
use crate::light_field::file as light_field_file;
use crate::pipeline::stage::Sink;
use crate::progress::Progress as _;
use crate::quality::figures::Summary;
use crate::recording::folder::Recording;
use crate::synthetic::simulation::{Settings, simulate};
use crate::time::{Clock as _, MonotonicClock, Timestamp};

/// What the demo makes and, with --force, makes anew.
const MADE: [&str; 8] = [
    "simulation",
    "light_field",
    "enhanced.mp4",
    "side_by_side.mp4",
    "specular_only.mp4",
    "before_after.png",
    "report.md",
    "report.json",
];
/// Views of the demo's light field: enough for its small scene, few enough for its three minutes.
const VIEWS: usize = 48;

/// Everything once, without hardware: simulates a survey and a live recording, builds the light field, enhances the live recording,
/// and measures the result against the known truth.
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = "Example:\n  endofield demo -o /tmp/endofield-demo\n\n\
    writes enhanced.mp4, side_by_side.mp4, before_after.png, report.md and report.json; takes about three minutes on two cores.")]
pub struct Args {
    /// Folder to make.
    #[arg(short, long, value_name = "DIR", default_value = "endofield-demo")]
    output: PathBuf,
    /// Everything random follows from it.
    #[arg(long, default_value_t = 1)]
    seed: u64,
}

/// Seconds spent per part.
#[derive(Clone, Copy, Debug, Default, Serialize)]
struct Parts {
    simulate_s: f64,
    light_field_s: f64,
    whole_line_s: f64,
    measure_s: f64,
}

#[derive(Debug, Serialize)]
struct DemoReport<'a> {
    quality: Summary,
    parts: Parts,
    whole_line: &'a Report,
    measured_line: &'a Report,
}

/// Run it.
pub fn run(args: &Args, context: &Context) -> anyhow::Result<Ended> {
    let folder = &args.output;
    make_room(folder, context)?;
    let mut parts = Parts::default();

    tracing::info!("1 of 4: simulating an operation (survey and live recording, with the truth)");
    let began = MonotonicClock.now();
    let simulation = folder.join("simulation");
    let settings = Settings {
        seed: args.seed,
        ..Settings::default()
    };
    simulate(&simulation, &settings, &context.console).context("simulating")?;
    parts.simulate_s = since(began);
    if context.console.stopping() {
        return Ok(Ended::Interrupted);
    }

    tracing::info!("2 of 4: building the light field from the survey");
    let began = MonotonicClock.now();
    let light_field_folder = folder.join("light_field");
    let wanted = light_field::Wanted {
        views: VIEWS,
        refine: true,
        telescope_angle_deg: None,
    };
    let (light_field, _) = light_field::built(&simulation.join("survey"), wanted, &context.config, &context.console)
        .context("building the light field")?;
    light_field_file::save(&light_field, &light_field_folder, &context.console)?;
    drop(light_field);
    parts.light_field_s = since(began);
    if context.console.stopping() {
        return Ok(Ended::Interrupted);
    }

    tracing::info!("3 of 4: the whole line on the live recording");
    let began = MonotonicClock.now();
    let live = simulation.join("live");
    let whole = process::Args {
        input: live.clone(),
        output: folder.join("enhanced.mp4"),
        light_field: Some(light_field_folder),
        stages: Choice::ALL.to_vec(),
        mask_out: None,
        side_by_side: Some(folder.join("side_by_side.mp4")),
        report: None,
        start: None,
        end: None,
        telescope_angle_deg: None,
    };
    let enhanced = process(&whole, context, Vec::new()).context("enhancing the live recording")?;
    parts.whole_line_s = since(began);
    if enhanced.ended != Ended::Complete {
        return Ok(enhanced.ended);
    }

    tracing::info!("4 of 4: specularities alone, measured against the truth");
    let began = MonotonicClock.now();
    let measured = Arc::new(Mutex::new(Measured::default()));
    let camera = Recording::open(&live)?
        .camera
        .context("expected the simulated recording to have a camera.yaml, found none")?;
    let sink = MeasureSink::new(
        &simulation.join("truth/live"),
        &camera,
        &context.config.undistort,
        Arc::clone(&measured),
    )?;
    let alone = process::Args {
        output: folder.join("specular_only.mp4"),
        stages: vec![Choice::Undistort, Choice::Specular],
        side_by_side: None,
        ..whole
    };
    let extra: Vec<Box<dyn Sink>> = vec![Box::new(sink)];
    let specular = process(&alone, context, extra).context("measuring")?;
    parts.measure_s = since(began);
    if specular.ended != Ended::Complete {
        return Ok(specular.ended);
    }

    let measured = measured.lock().unwrap_or_else(PoisonError::into_inner);
    let quality = measured.figures.summary();
    if let Some(picture) = before_after(&measured) {
        let path = folder.join("before_after.png");
        let (width, height) = (picture.width() as u32, picture.height() as u32);
        image::save_buffer(&path, picture.as_bytes(), width, height, image::ColorType::Rgb8)
            .with_context(|| format!("writing {}", path.display()))?;
    }
    let report = DemoReport {
        quality,
        parts,
        whole_line: &enhanced.report,
        measured_line: &specular.report,
    };
    write(&folder.join("report.json"), &(serde_json::to_string_pretty(&report)? + "\n"))?;
    let text = markdown(&report, &settings);
    write(&folder.join("report.md"), &text)?;
    console::print(&format!("\n{}\n{}", quality_table(&quality), enhanced.report.timing_table()))?;
    console::print(&format!(
        "\nLook at:\n  {0}/before_after.png   before | after | truth, where it glares most\n  {0}/side_by_side.mp4   before and after\n  \
         {0}/enhanced.mp4       the enhanced video\n  {0}/report.md          what was measured\n",
        folder.display()
    ))?;
    Ok(Ended::Complete)
}

fn since(began: Timestamp) -> f64 {
    (MonotonicClock.now() - began).seconds()
}

fn write(path: &Path, text: &str) -> anyhow::Result<()> {
    std::fs::write(path, text).with_context(|| format!("{}: cannot be written; check folder, rights and space", path.display()))
}

/// An empty place; with --force what an earlier demo made there is removed, and nothing else.
fn make_room(folder: &Path, context: &Context) -> anyhow::Result<()> {
    if folder.is_file() {
        bail!(
            "{}: expected a folder or nothing there, found a file; name another folder with -o",
            folder.display()
        );
    }
    context.refuse_overwriting(folder)?;
    for name in MADE {
        let path = folder.join(name);
        let removed = if path.is_dir() {
            std::fs::remove_dir_all(&path)
        } else {
            std::fs::remove_file(&path)
        };
        match removed {
            Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
                return Err(error).with_context(|| format!("removing {}", path.display()));
            }
            _ => {}
        }
    }
    std::fs::create_dir_all(folder).with_context(|| format!("making {}", folder.display()))
}

/// One line per figure: its name, as it is, enhanced.
fn rows(quality: &Summary) -> Vec<[String; 3]> {
    let (before, after) = (&quality.as_it_is, &quality.output);
    // A figure that nothing was there to measure for is no number.
    let shown = |text: String| if text.contains("NaN") { "–".to_owned() } else { text };
    let row = |name: &str, before: String, after: String| [name.to_owned(), shown(before), shown(after)];
    let percent = |share: f64| format!("{:.2} %", 100.0 * share);
    let none = || "–".to_owned();
    vec![
        row(
            "texture PSNR in the specular mask",
            format!("{:.1} dB", before.texture_psnr),
            format!("{:.1} dB", after.texture_psnr),
        ),
        row(
            "SSIM in the specular mask",
            format!("{:.3}", before.ssim),
            format!("{:.3}", after.ssim),
        ),
        row(
            "plain PSNR in the specular mask",
            format!("{:.1} dB", before.plain_psnr),
            format!("{:.1} dB", after.plain_psnr),
        ),
        row(
            "jitter (mask over ring)",
            format!("{:.2}", before.jitter),
            format!("{:.2}", after.jitter),
        ),
        row("recall of strong specular pixels", none(), percent(quality.recall)),
        row("false touches", none(), percent(quality.false_touches)),
        row(
            "PSNR elsewhere, against the input",
            none(),
            format!("{:.1} dB", quality.elsewhere_psnr),
        ),
        row("instrument pixels painted", none(), quality.instrument_painted.to_string()),
        row(
            "filled pixels from the light field",
            none(),
            percent(quality.from_light_field),
        ),
    ]
}

fn quality_table(quality: &Summary) -> String {
    let mut table = format!("  {:<38}{:>12}{:>12}\n", "against the truth", "as it is", "enhanced");
    for [name, before, after] in rows(quality) {
        let _infallible = writeln!(table, "  {name:<38}{before:>12}{after:>12}");
    }
    table
}

fn markdown(report: &DemoReport<'_>, settings: &Settings) -> String {
    let mut text = format!(
        "# endofield demo\n\nA simulated operation, {}x{} px, {} live frames, survey of {} frames, seed {}. \
         The arm's poses are noisy and {:.0} ms late, as set in the simulation.\n\n\
         ## Quality\n\nSpecularities alone (stages undistort, specular) against the diffuse render.\n\n\
         | figure | as it is | enhanced |\n|---|---|---|\n",
        settings.width,
        settings.height,
        settings.live_frames,
        settings.survey_frames,
        settings.seed,
        settings.arm.late_s * 1e3
    );
    for [name, before, after] in rows(&report.quality) {
        let _infallible = writeln!(text, "| {name} | {before} | {after} |");
    }
    let line = report.whole_line;
    let _infallible = writeln!(text, "\n## Time\n\nThe whole line, {:.1} fps.\n", line.frames_per_second);
    text += "| stage | p50 ms | p95 ms | p99 ms | max ms |\n|---|---|---|---|---|\n";
    let stages = line.stages.iter().map(|stage| (stage.name.as_str(), &stage.working));
    for (name, times) in [("source", &line.source)]
        .into_iter()
        .chain(stages)
        .chain([("end to end", &line.end_to_end)])
    {
        let _infallible = writeln!(
            text,
            "| {name} | {:.1} | {:.1} | {:.1} | {:.1} |",
            times.p50_ms, times.p95_ms, times.p99_ms, times.max_ms
        );
    }
    let parts = &report.parts;
    let _infallible = writeln!(
        text,
        "\nSimulation {:.0} s, light field {:.0} s, whole line {:.0} s, measurement {:.0} s.",
        parts.simulate_s, parts.light_field_s, parts.whole_line_s, parts.measure_s
    );
    if !line.left_out.is_empty() {
        text += "\n## Left out\n\n";
        for part in &line.left_out {
            let _infallible = writeln!(text, "- {part}");
        }
    }
    text
}
