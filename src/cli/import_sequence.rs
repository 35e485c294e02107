//! `import`: a recording from MetaImage sequences, as PLUS and 3D Slicer write them.

use std::collections::BTreeMap;
use std::fs;
use std::path::PathBuf;

use anyhow::{Context as _, bail};
use rayon::prelude::*;

use crate::cli::context::{Context, Ended, UsageError};
use crate::geometry::transform::Transform;
use crate::media::image_files;
use crate::progress::Progress as _;
use crate::recording::meta_image::MetaSequence;
use crate::robot::trajectory::{TimedPose, Trajectory, stamp_text};
use crate::time::Timestamp;

/// Make a recording of MetaImage sequences (PLUS, 3D Slicer): pictures and tracker poses from one file or from two.
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:
  endofield import VideoBuffer.igs.mha TrackerBuffer.igs.mha --pose ProbeToTracker -o recording
  endofield calibrate time-offset recording --plot offset.png

Frames whose picture is not OK are left out, and poses whose status is not OK are gaps. The tracker takes the arm's part: the pose is
base_from_hand, the tracker (or --reference) being the base and the probe the hand.")]
pub struct Args {
    /// Sequences: .mha, .igs.mha, .seq.mha.
    #[arg(required = true)]
    sequences: Vec<PathBuf>,
    /// The recording to make: a folder.
    #[arg(short, long, value_name = "RECORDING")]
    output: PathBuf,
    /// The pose to take, such as ProbeToTracker; not needed where there is only one.
    #[arg(long, value_name = "AToB")]
    pose: Option<String>,
    /// Take the pose relative to another in the same space, such as ReferenceToTracker.
    #[arg(long, value_name = "CToB")]
    reference: Option<String>,
}

/// Run it.
pub fn run(args: &Args, context: &Context) -> anyhow::Result<Ended> {
    context.refuse_overwriting(&args.output)?;
    let sequences = args
        .sequences
        .iter()
        .map(|path| Ok(MetaSequence::open(path)?))
        .collect::<anyhow::Result<Vec<_>>>()?;
    let trajectory = trajectory(args, &sequences)?;
    let with_pictures: Vec<&MetaSequence> = sequences.iter().filter(|sequence| sequence.size != (0, 0)).collect();
    let [pictures] = with_pictures.as_slice() else {
        bail!("expected one sequence with pictures, found {}", with_pictures.len());
    };
    let frames = args.output.join("frames");
    fs::create_dir_all(&frames).with_context(|| format!("cannot make {}", frames.display()))?;
    for entry in fs::read_dir(&frames)?
        .flatten()
        .filter(|entry| image_files::is_picture(&entry.path()))
    {
        fs::remove_file(entry.path()).with_context(|| format!("cannot replace {}", entry.path().display()))?;
    }
    let count = write_pictures(args, pictures, context)?;
    if context.console.stopping() {
        return Ok(Ended::Interrupted);
    }
    if let Some(trajectory) = &trajectory {
        trajectory.write(&args.output.join("poses.tum"))?;
    }
    let poses = trajectory.map_or(0, |trajectory| trajectory.poses().len());
    tracing::info!("{}: {count} pictures, {poses} poses", args.output.display());
    Ok(Ended::Complete)
}

/// Frames with a picture and a stamp later than the one before, written as they come.
fn write_pictures(args: &Args, sequence: &MetaSequence, context: &Context) -> anyhow::Result<usize> {
    let pixels = sequence.pixels()?;
    let mut last = None;
    let mut kept: Vec<(usize, Timestamp)> = Vec::new();
    for (number, frame) in sequence.frames.iter().enumerate() {
        if let Some(at) = frame.at.filter(|at| frame.has_picture && last.is_none_or(|last| *at > last)) {
            kept.push((number, at));
            last = Some(at);
        }
    }
    let left_out = sequence.frames.len() - kept.len();
    if left_out > 0 {
        tracing::warn!(
            "{left_out} of {} frames have no picture or no later stamp; left out",
            sequence.frames.len()
        );
    }
    if kept.is_empty() {
        bail!("expected pictures with time stamps, found none");
    }
    context.console.begin("pictures", kept.len() as u64);
    kept.par_iter().enumerate().try_for_each(|(place, (number, _))| {
        if context.console.stopping() {
            return Ok(());
        }
        let picture = pixels.picture(*number).context("the file ends before its last picture")?;
        image_files::write(&args.output.join(format!("frames/{place:06}.png")), &picture)?;
        context.console.advance(1);
        anyhow::Ok(())
    })?;
    context.console.end();
    let mut text = "frame,timestamp_s\n".to_owned();
    for (place, (_, at)) in kept.iter().enumerate() {
        text.push_str(&format!("{place},{}\n", stamp_text(*at)));
    }
    let path = args.output.join("frames.csv");
    fs::write(&path, text).with_context(|| format!("cannot write {}", path.display()))?;
    Ok(kept.len())
}

fn trajectory(args: &Args, sequences: &[MetaSequence]) -> anyhow::Result<Option<Trajectory>> {
    let names: Vec<&String> = sequences.iter().flat_map(|sequence| &sequence.transforms).collect();
    let list = || names.iter().map(|name| name.as_str()).collect::<Vec<_>>().join(", ");
    let wanted = match (&args.pose, names.as_slice()) {
        (Some(name), _) => name,
        (None, []) => {
            tracing::warn!("the sequences hold no poses");
            return Ok(None);
        }
        (None, [only]) => only,
        (None, _) => bail!(UsageError(format!("--pose: expected one of {}, found none", list()))),
    };
    for name in std::iter::once(wanted).chain(&args.reference) {
        if names.is_empty() {
            bail!(
                "expected a sequence with poses for `{name}`, found none in the files given: is the tracker's file among them?"
            );
        }
        if !names.contains(&name) {
            bail!(UsageError(format!("expected a pose out of {}, found {name}", list())));
        }
    }
    let mut by_stamp = BTreeMap::new();
    let mut named = 0;
    for sequence in sequences.iter().filter(|sequence| sequence.transforms.contains(wanted)) {
        named += sequence.frames.len();
        for frame in &sequence.frames {
            let (Some(at), Some(pose)) = (frame.at, frame.transforms.get(wanted)) else {
                continue;
            };
            let pose = match &args.reference {
                None => *pose,
                Some(name) => match frame.transforms.get(name) {
                    Some(reference) => reference.inverse() * pose,
                    None => continue,
                },
            };
            by_stamp.entry(at).or_insert(pose);
        }
    }
    let missing = named - by_stamp.len();
    if missing > 0 {
        tracing::warn!("{missing} of {named} poses are not OK or repeat a stamp; left out");
    }
    let poses = by_stamp.into_iter().map(|(stamp, pose)| TimedPose {
        stamp,
        base_from_hand: Transform::from_isometry(pose),
    });
    let trajectory =
        Trajectory::new(poses.collect()).with_context(|| format!("expected poses {wanted} that are OK, found none"))?;
    Ok(Some(trajectory))
}
