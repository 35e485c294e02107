//! libavfilter as a pipe: decoded frames in, filtered frames out.

use ffmpeg_next::{Error, Rational, filter, frame};

/// Weaves the two fields of interlaced video into full frames (w3fdif and yadif combined); one frame out per frame in.
pub(crate) const DEINTERLACE: &str = "bwdif=mode=send_frame:parity=auto:deint=interlaced";

/// A chain of filters for frames of one size and format.
pub(crate) struct Filter {
    graph: filter::Graph,
}

impl std::fmt::Debug for Filter {
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.write_str("Filter")
    }
}

impl Filter {
    /// The chain `description` (ffmpeg's `-vf` syntax) for frames like `model`, stamped in units of `time_base`.
    pub(crate) fn new(model: &frame::Video, time_base: Rational, description: &str) -> Result<Self, Error> {
        let mut graph = filter::Graph::new();
        let format = model.format().descriptor().ok_or(Error::InvalidData)?.name();
        let aspect = model.aspect_ratio();
        let aspect = if aspect.numerator() > 0 { aspect } else { Rational(1, 1) };
        let arguments = format!(
            "video_size={}x{}:pix_fmt={format}:time_base={}/{}:pixel_aspect={}/{}",
            model.width(),
            model.height(),
            time_base.numerator(),
            time_base.denominator(),
            aspect.numerator(),
            aspect.denominator()
        );
        graph.add(&filter::find("buffer").ok_or(Error::FilterNotFound)?, "in", &arguments)?;
        graph.add(&filter::find("buffersink").ok_or(Error::FilterNotFound)?, "out", "")?;
        graph.output("in", 0)?.input("out", 0)?.parse(description)?;
        graph.validate()?;
        Ok(Self { graph })
    }

    /// Hand a frame in; its pixels move into the chain.
    pub(crate) fn push(&mut self, frame: &frame::Video) -> Result<(), Error> {
        self.graph.get("in").ok_or(Error::FilterNotFound)?.source().add(frame)
    }

    /// No more frames will come.
    pub(crate) fn flush(&mut self) -> Result<(), Error> {
        self.graph.get("in").ok_or(Error::FilterNotFound)?.source().flush()
    }

    /// The next finished frame, if one is ready.
    pub(crate) fn pull(&mut self, out: &mut frame::Video) -> Result<bool, Error> {
        match self.graph.get("out").ok_or(Error::FilterNotFound)?.sink().frame(out) {
            Ok(()) => Ok(true),
            Err(
                Error::Eof
                | Error::Other {
                    errno: ffmpeg_next::error::EAGAIN,
                },
            ) => Ok(false),
            Err(error) => Err(error),
        }
    }

    /// Units of the time stamps that come out.
    pub(crate) fn time_base(&mut self) -> Option<Rational> {
        Some(self.graph.get("out")?.sink().time_base())
    }
}
