//! Pictures to calibrate from: files, folders, and evenly chosen frames of recordings.

use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::PoisonError;

use anyhow::Context as _;
use rayon::prelude::*;

use crate::image::buffer::{Image, Rgb8};
use crate::image::pool::Pool;
use crate::media::image_files;
use crate::media::reader::{Input, VideoReader};
use crate::progress::Progress;
use crate::recording::folder::{Recording, Video};

/// Frames decoded before they are looked at together.
const BATCH: usize = 8;

#[derive(Debug)]
enum Source {
    File(PathBuf),
    /// A video of which every so many-th frame counts.
    Video(PathBuf),
}

/// What came of one picture.
#[derive(Debug)]
pub struct Seen<T> {
    /// File name, or video and frame number.
    pub name: String,
    /// Columns and rows.
    pub size: (usize, usize),
    /// The frame's number in a recording or folder of frames, else the place in the list.
    pub frame: u64,
    /// What was made of it.
    pub found: T,
}

/// Look at every picture that `inputs` name, of a recording at about `frames` of them; results in the order of the inputs.
pub fn look_at_all<T: Send>(
    inputs: &[PathBuf],
    frames: usize,
    progress: &dyn Progress,
    look: &(dyn Fn(&Image<Rgb8>) -> T + Sync),
) -> anyhow::Result<Vec<Seen<T>>> {
    let mut sources = Vec::new();
    for input in inputs {
        sources.extend(sources_of(input, frames)?);
    }
    anyhow::ensure!(
        !sources.is_empty(),
        "expected pictures, found none; name files, folders or recordings"
    );
    let total: usize = sources
        .iter()
        .map(|source| match source {
            Source::File(_) => 1,
            Source::Video(_) => frames,
        })
        .sum();
    progress.begin("looking for boards", total as u64);
    let outcome = look_at_sources(&sources, frames, progress, look);
    progress.end();
    outcome
}

fn look_at_sources<T: Send>(
    sources: &[Source],
    frames: usize,
    progress: &dyn Progress,
    look: &(dyn Fn(&Image<Rgb8>) -> T + Sync),
) -> anyhow::Result<Vec<Seen<T>>> {
    let results: Mutex<Vec<(usize, Vec<Seen<T>>)>> = Mutex::new(Vec::new());
    sources
        .par_iter()
        .enumerate()
        .try_for_each(|(place, source)| -> anyhow::Result<()> {
            anyhow::ensure!(!progress.stopping(), "stopped before all pictures were looked at");
            let seen = match source {
                Source::File(path) => {
                    let image = image_files::read(path)?;
                    let seen = Seen {
                        name: name_of(path),
                        size: image.size(),
                        frame: image_files::last_number(&name_of(path)).unwrap_or(place as u64),
                        found: look(&image),
                    };
                    progress.advance(1);
                    vec![seen]
                }
                Source::Video(path) => look_at_video(path, frames, progress, look)?,
            };
            results.lock().unwrap_or_else(PoisonError::into_inner).push((place, seen));
            Ok(())
        })?;
    let mut results = results.into_inner().unwrap_or_else(PoisonError::into_inner);
    results.sort_by_key(|(place, _)| *place);
    Ok(results.into_iter().flat_map(|(_, seen)| seen).collect())
}

fn look_at_video<T: Send>(
    path: &Path,
    frames: usize,
    progress: &dyn Progress,
    look: &(dyn Fn(&Image<Rgb8>) -> T + Sync),
) -> anyhow::Result<Vec<Seen<T>>> {
    let mut reader = VideoReader::open(&Input::from_argument(path))?;
    let pool = Pool::new(BATCH + 1);
    // A container that does not say how long it is: a frame of each half second.
    let every = reader
        .info()
        .frame_count
        .map_or(12, |count| count.div_ceil(frames.max(1) as u64).max(1));
    let mut seen = Vec::new();
    let mut ended = false;
    while !ended {
        let mut batch = Vec::new();
        while batch.len() < BATCH && !ended {
            anyhow::ensure!(!progress.stopping(), "stopped before all pictures were looked at");
            match reader.next_frame(&pool)? {
                Some(frame) if frame.number % every == 0 => batch.push(frame),
                Some(_) => {}
                None => ended = true,
            }
        }
        seen.par_extend(batch.par_iter().map(|frame| {
            let found = look(&frame.image);
            progress.advance(1);
            Seen {
                name: format!("{} frame {}", name_of(path), frame.number),
                size: frame.image.size(),
                frame: frame.number,
                found,
            }
        }));
    }
    Ok(seen)
}

fn sources_of(input: &Path, frames: usize) -> anyhow::Result<Vec<Source>> {
    if !input.is_dir() {
        anyhow::ensure!(
            input.exists(),
            "{}: expected a picture, folder or recording, found nothing",
            input.display()
        );
        let source = if image_files::is_picture(input) {
            Source::File
        } else {
            Source::Video
        };
        return Ok(vec![source(input.to_owned())]);
    }
    let pictures = pictures_in(input)?;
    // A plain folder of pictures: the user chose them, so all are looked at.
    if !pictures.is_empty() {
        return Ok(pictures.into_iter().map(Source::File).collect());
    }
    match Recording::open(input)?.video {
        Video::File(path) => Ok(vec![Source::Video(path)]),
        Video::Frames(folder) => {
            let pictures = pictures_in(&folder)?;
            let every = pictures.len().div_ceil(frames.max(1)).max(1);
            Ok(pictures.into_iter().step_by(every).map(Source::File).collect())
        }
    }
}

/// Pictures that lie in a folder itself, by name.
fn pictures_in(folder: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let entries = std::fs::read_dir(folder).with_context(|| format!("{}: cannot be listed", folder.display()))?;
    let mut pictures: Vec<PathBuf> = entries
        .flatten()
        .map(|entry| entry.path())
        .filter(|path| image_files::is_picture(path))
        .collect();
    pictures.sort();
    Ok(pictures)
}

fn name_of(path: &Path) -> String {
    path.file_name()
        .map_or_else(|| path.display().to_string(), |name| name.to_string_lossy().into_owned())
}
