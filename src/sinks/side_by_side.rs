//! Before and after in one picture: as it came on the left, enhanced on the right.

use std::sync::Arc;

use crate::frame::Frame;
use crate::image::buffer::{Image, Rgb8};
use crate::media::writer::VideoWriter;
use crate::pipeline::stage::{Sink, SinkError};

/// Columns between the two pictures; even, so that 4:2:0 stays possible.
const DIVIDER_COLUMNS: usize = 4;
const DIVIDER: Rgb8 = [255, 255, 255];

/// Writes original and enhanced picture beside each other.
#[derive(Debug)]
pub struct SideBySideSink {
    writer: VideoWriter,
    canvas: Image<Rgb8>,
}

impl SideBySideSink {
    /// Width of the output for pictures `width` columns wide.
    pub fn output_width(width: usize) -> usize {
        2 * width + DIVIDER_COLUMNS
    }

    /// A sink that writes with `writer`, which was opened [`output_width`](Self::output_width) wide.
    pub fn new(writer: VideoWriter) -> Self {
        Self {
            writer,
            canvas: Image::filled(0, 0, DIVIDER),
        }
    }
}

/// Put two pictures of one size on a canvas, left and right of a divider.
fn compose(left: &Image<Rgb8>, right: &Image<Rgb8>, canvas: &mut Image<Rgb8>) {
    let (width, height) = right.size();
    let size = (SideBySideSink::output_width(width), height);
    if canvas.size() != size {
        canvas.resize(size.0, size.1, DIVIDER);
    }
    for y in 0..height {
        let row = canvas.row_mut(y);
        let (before, after) = row.split_at_mut(width + DIVIDER_COLUMNS);
        before[..width].copy_from_slice(left.row(y));
        after.copy_from_slice(right.row(y));
    }
}

impl Sink for SideBySideSink {
    fn name(&self) -> &'static str {
        "side_by_side"
    }

    fn consume(&mut self, frame: &Arc<Frame>) -> Result<(), SinkError> {
        let Some(original) = frame
            .original
            .as_ref()
            .filter(|original| original.size() == frame.image.size())
        else {
            return Err(SinkError(
                "side by side: expected the source to keep each picture as it came, found none".to_owned(),
            ));
        };
        compose(original, &frame.image, &mut self.canvas);
        self.writer
            .write(&self.canvas, frame.presented_at)
            .map_err(|error| SinkError(error.to_string()))
    }

    fn finish(&mut self) -> Result<(), SinkError> {
        self.writer.finish().map_err(|error| SinkError(error.to_string()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_pictures_and_the_divider_are_where_they_belong() {
        let left = Image::filled(3, 2, [10, 20, 30]);
        let right = Image::filled(3, 2, [40, 50, 60]);
        let mut canvas = Image::filled(0, 0, [0; 3]);
        compose(&left, &right, &mut canvas);
        assert_eq!(canvas.size(), (10, 2));
        for y in 0..2 {
            assert_eq!(canvas.row(y)[..3], [[10, 20, 30]; 3]);
            assert_eq!(canvas.row(y)[3..7], [DIVIDER; 4]);
            assert_eq!(canvas.row(y)[7..], [[40, 50, 60]; 3]);
        }
    }
}
