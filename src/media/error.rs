//! What can go wrong with a video, told so that the user knows what to do next.

use std::path::{Path, PathBuf};

/// Why a video could not be read or written.
#[derive(Debug, thiserror::Error)]
pub enum MediaError {
    /// No such file.
    #[error("{}: expected a video, found no such file or folder; check the path", path.display())]
    Missing {
        /// The path asked for.
        path: PathBuf,
    },
    /// A file of no bytes.
    #[error("{}: expected a video, found an empty file (0 bytes); copy it again or choose another", path.display())]
    Empty {
        /// The file.
        path: PathBuf,
    },
    /// Not a video, or one cut off before its index.
    #[error("{name}: expected a video, found {found}; {advice}")]
    NotAVideo {
        /// The file or stream.
        name: String,
        /// What libav made of it.
        found: String,
        /// What to do.
        advice: String,
    },
    /// Sound or subtitles only.
    #[error("{name}: expected a video stream, found only {found}; choose a file with pictures in it")]
    NoVideoStream {
        /// The file or stream.
        name: String,
        /// The streams that are there.
        found: String,
    },
    /// No decoder in this libav.
    #[error(
        "{name}: no decoder for {codec} in the installed libav; convert it with `ffmpeg -i INPUT -c:v libx264 -crf 12 OUTPUT.mp4`"
    )]
    NoDecoder {
        /// The file or stream.
        name: String,
        /// The codec's name.
        codec: String,
    },
    /// The data end before the video does.
    #[error(
        "{name}: expected the video to go on, found {found} after frame {frames} ({seconds:.3} s); what came before was used, \
         copy the file again to get the rest"
    )]
    Truncated {
        /// The file or stream.
        name: String,
        /// What was found instead of more frames.
        found: String,
        /// Frames read until then.
        frames: u64,
        /// Time stamp of the last of them, s.
        seconds: f64,
    },
    /// The picture's size changes in mid-stream.
    #[error(
        "{name}: expected pictures of {}×{}, found {}×{} at frame {frame} ({seconds:.3} s); split the recording there and process \
         the parts one by one", expected.0, expected.1, found.0, found.1
    )]
    SizeChanged {
        /// The file or stream.
        name: String,
        /// Width and height of the first frame.
        expected: (usize, usize),
        /// Width and height of the odd one.
        found: (usize, usize),
        /// Number of the odd one.
        frame: u64,
        /// Its time stamp, s.
        seconds: f64,
    },
    /// A folder or pattern without pictures.
    #[error("{}: expected numbered pictures (PNG, JPEG, TIFF, PNM), found none; check the folder or pattern", path.display())]
    NoImages {
        /// Folder or pattern.
        path: PathBuf,
    },
    /// A picture that cannot be read or written.
    #[error("{}: expected a picture, found: {reason}; replace or remove it", path.display())]
    Image {
        /// The picture.
        path: PathBuf,
        /// What the decoder said.
        reason: String,
    },
    /// The decoder or a filter refused.
    #[error("{name}: decoding failed at frame {frame}: {reason}; if a player shows it, convert it with ffmpeg and try again")]
    Decode {
        /// The file or stream.
        name: String,
        /// Number of the frame that was due.
        frame: u64,
        /// What libav said.
        reason: String,
    },
    /// The output is there already.
    #[error("{}: exists already and is not overwritten; remove it, choose another name or pass --force", path.display())]
    Exists {
        /// The file.
        path: PathBuf,
    },
    /// Reading and writing the same file.
    #[error("{}: is the input as well; choose another output", path.display())]
    SameAsInput {
        /// The file.
        path: PathBuf,
    },
    /// An output we do not know how to write.
    #[error("{}: expected an output that ends in .mp4, .mkv, .avi, .mov or /, holds %06d or is -, found {found}", path.display())]
    UnknownOutput {
        /// The path asked for.
        path: PathBuf,
        /// Its ending.
        found: String,
    },
    /// The output could not be opened.
    #[error("{}: cannot be written: {reason}; check folder, rights and space", path.display())]
    Create {
        /// The file.
        path: PathBuf,
        /// What the system or libav said.
        reason: String,
    },
    /// Writing failed in the middle, most often a full disk.
    #[error("{}: writing failed after {frames} frames: {reason}; what was written stays playable, make room and run again", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// Frames handed to the encoder until then.
        frames: u64,
        /// What the system or libav said.
        reason: String,
    },
    /// A frame of another size than the output.
    #[error("{}: expected frames of {}×{}, was given {}×{}", path.display(), expected.0, expected.1, found.0, found.1)]
    WrongSize {
        /// The file.
        path: PathBuf,
        /// Size of the output.
        expected: (usize, usize),
        /// Size of the frame.
        found: (usize, usize),
    },
    /// Colour given to a mask writer, or the reverse.
    #[error("{}: opened for {expected} frames, was given another kind", path.display())]
    WrongKind {
        /// The file.
        path: PathBuf,
        /// "colour" or "mask".
        expected: &'static str,
    },
}

/// A path as libav takes it: UTF-8, no NUL, and no `name:` that it would take for a protocol.
pub(crate) fn libav_path(path: &Path) -> Result<String, MediaError> {
    match path.to_str() {
        Some(text) if !text.contains('\0') => Ok(format!("file:{text}")),
        _ => Err(MediaError::Create {
            path: path.into(),
            reason: "the name is not valid UTF-8".into(),
        }),
    }
}

/// The error for what libav cannot make a video of.
pub(crate) fn not_a_video(path: &Path, found: &str, advice: &str) -> MediaError {
    MediaError::NotAVideo {
        name: path.display().to_string(),
        found: found.to_owned(),
        advice: advice.to_owned(),
    }
}
