//! What the live window shows, pixel by pixel: raw, enhanced or both, provenance over it, figures below.

use rayon::prelude::*;

use crate::frame::{Frame, Provenance, provenance_code};
use crate::image::buffer::{Image, Rgb8};
use crate::image::canvas::Canvas;

/// Which picture.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Show {
    /// As it came.
    Raw,
    /// As it leaves the line.
    #[default]
    Enhanced,
    /// Raw on the left, enhanced on the right.
    Split,
}

/// Colors of the overlay: replaced from the light field, from recent frames, left though specular.
const LIGHT_FIELD: Rgb8 = [0, 220, 90];
const RECENT: Rgb8 = [0, 170, 255];
const LEFT: Rgb8 = [255, 210, 0];
/// Height of a line of words, px.
const LINE_PX: usize = 26;
/// Left and right of words, px.
const BORDER_PX: usize = 4;
/// Width of a letter, px.
const LETTER_PX: usize = 16;

/// Put the picture together in `out`; false when there is none yet.
pub fn put_together(show: Show, overlay: bool, raw: Option<&Frame>, finished: Option<&Frame>, out: &mut Image<Rgb8>) -> bool {
    let picture = match (show, raw, finished) {
        (Show::Raw, Some(raw), _) => raw,
        (_, _, Some(finished)) => finished,
        (_, Some(raw), None) => raw,
        (_, None, None) => return false,
    };
    out.copy_from(&picture.image);
    let Some(provenance) = picture.provenance.as_ref().filter(|_| overlay && show != Show::Raw) else {
        split(show, picture, out);
        return true;
    };
    tint(provenance, out);
    split(show, picture, out);
    true
}

/// The left half as it came, and a line between.
fn split(show: Show, picture: &Frame, out: &mut Image<Rgb8>) {
    if show != Show::Split {
        return;
    }
    let (width, height) = out.size();
    let middle = width / 2;
    // A frame that nothing was done to is its own original.
    let original = picture.original.as_deref().unwrap_or(&picture.image);
    if original.size() != (width, height) {
        return;
    }
    for y in 0..height {
        let row = out.row_mut(y);
        if let (Some(to), Some(from)) = (row.get_mut(..middle), original.row(y).get(..middle)) {
            to.copy_from_slice(from);
        }
        if let Some(pixel) = row.get_mut(middle) {
            *pixel = [255; 3];
        }
    }
}

fn tint(provenance: &Provenance, out: &mut Image<Rgb8>) {
    if provenance.code.size() != out.size() {
        return;
    }
    for (pixel, code) in out.pixels_mut().iter_mut().zip(provenance.code.pixels()) {
        let color = match *code {
            provenance_code::LIGHT_FIELD => LIGHT_FIELD,
            provenance_code::RECENT => RECENT,
            provenance_code::LEFT => LEFT,
            _ => continue,
        };
        *pixel = [0, 1, 2].map(|channel| pixel[channel] / 2 + color[channel] / 2);
    }
}

/// Draw the picture as large as it fits into a window's pixels (0x00RRGGBB), black around it.
pub fn fit(picture: &Image<Rgb8>, window: &mut [u32], (width, height): (usize, usize)) {
    let (w, h) = picture.size();
    if w == 0 || h == 0 || width == 0 || window.len() < width * height {
        return;
    }
    let scale = (width as f64 / w as f64).min(height as f64 / h as f64);
    let (shown_w, shown_h) = ((w as f64 * scale) as usize, (h as f64 * scale) as usize);
    let (left, top) = ((width - shown_w.min(width)) / 2, (height - shown_h.min(height)) / 2);
    // Between which two pixels, and how near the second in 1/256.
    let between = |at: usize, shown: usize, of: usize| {
        let place = ((at as f64 + 0.5) * of as f64 / shown as f64 - 0.5).clamp(0.0, of as f64 - 1.0);
        let first = place as usize;
        (first, (first + 1).min(of - 1), ((place - first as f64) * 256.0) as u32)
    };
    let columns: Vec<(usize, usize, u32)> = (0..shown_w).map(|x| between(x, shown_w, w)).collect();
    window.par_chunks_mut(width).take(height).enumerate().for_each(|(y, row)| {
        row.fill(0);
        if y < top || y >= top + shown_h {
            return;
        }
        let (upper, lower, down) = between(y - top, shown_h, h);
        let (upper, lower) = (picture.row(upper), picture.row(lower));
        for (to, &(first, second, right)) in row.iter_mut().skip(left).zip(&columns) {
            let (Some(a), Some(b), Some(c), Some(d)) = (upper.get(first), upper.get(second), lower.get(first), lower.get(second))
            else {
                continue;
            };
            let level = |channel: usize| {
                let across =
                    |left: &Rgb8, other: &Rgb8| u32::from(left[channel]) * (256 - right) + u32::from(other[channel]) * right;
                (across(a, b) * (256 - down) + across(c, d) * down + (1 << 15)) >> 16
            };
            *to = level(0) << 16 | level(1) << 8 | level(2);
        }
    });
}

/// Words at the lower border of a window, on dark, in as many lines as they take; a word is not cut.
pub fn words(text: &str, window: &mut [u32], (width, height): (usize, usize)) {
    let most = (width.saturating_sub(2 * BORDER_PX) / LETTER_PX).max(1);
    let mut lines = vec![String::new()];
    for part in text.split(' ') {
        let full = lines
            .last()
            .is_some_and(|line| !line.is_empty() && line.chars().count() + 1 + part.chars().count() > most);
        if full || part == "\n" {
            lines.push(String::new());
        }
        if let Some(line) = lines.last_mut().filter(|_| part != "\n") {
            if !line.is_empty() {
                line.push(' ');
            }
            line.push_str(part);
        }
    }
    let tall = (LINE_PX * lines.len()).min(height);
    let mut canvas = Canvas::new(width, tall, [0; 3]);
    for (number, line) in lines.iter().enumerate() {
        canvas.text(BORDER_PX, BORDER_PX + number * LINE_PX, line, [230; 3]);
    }
    let below = window.iter_mut().skip((height - tall) * width);
    for (to, from) in below.zip(canvas.image.pixels()) {
        if *from == [0; 3] {
            *to = (*to >> 2) & 0x003f_3f3f;
        } else {
            *to = u32::from(from[0]) << 16 | u32::from(from[1]) << 8 | u32::from(from[2]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frame::FrameId;
    use crate::image::pool::Pool;
    use crate::time::Timestamp;

    fn frame(level: u8) -> Frame {
        let mut image = Pool::new(1).take(8, 4);
        image.fill([level; 3]);
        Frame::new(FrameId(0), Timestamp(0), Timestamp(0), image)
    }

    fn shown(show: Show, overlay: bool) -> Image<Rgb8> {
        let (raw, mut finished) = (frame(10), frame(200));
        let mut original = Pool::new(1).take(8, 4);
        original.fill([12; 3]);
        finished.original = Some(original);
        let mut provenance = Provenance {
            code: Pool::new(1).take(8, 4),
            view: Pool::new(1).take(8, 4),
            confidence: Pool::new(1).take(8, 4),
        };
        provenance.code.fill(0);
        provenance.code.set(7, 0, provenance_code::LIGHT_FIELD);
        finished.provenance = Some(provenance);
        let mut out = Image::filled(0, 0, [0; 3]);
        assert!(put_together(show, overlay, Some(&raw), Some(&finished), &mut out));
        out
    }

    #[test]
    fn raw_enhanced_split_and_what_was_replaced() {
        assert_eq!(shown(Show::Raw, true).at(7, 0), [10; 3], "raw is raw");
        assert_eq!(shown(Show::Enhanced, false).at(7, 0), [200; 3]);
        assert_eq!(shown(Show::Enhanced, true).at(7, 0), [100, 210, 145]);
        let split = shown(Show::Split, false);
        assert_eq!(
            (split.at(0, 0), split.at(4, 0), split.at(5, 0)),
            ([12; 3], [255; 3], [200; 3])
        );
        let mut out = Image::filled(0, 0, [0; 3]);
        assert!(!put_together(Show::Enhanced, false, None, None, &mut out));
        assert!(
            put_together(Show::Enhanced, false, Some(&frame(3)), None, &mut out),
            "the raw picture until there is another"
        );
    }

    #[test]
    fn a_picture_fills_the_window_as_far_as_its_shape_allows() {
        let mut picture = Image::filled(4, 2, [100, 0, 0]);
        picture.set(3, 1, [0, 0, 250]);
        let mut window = vec![7; 8 * 8];
        fit(&picture, &mut window, (8, 8));
        // Twice as large, two rows of black above and below.
        assert!(window[..16].iter().chain(&window[48..]).all(|pixel| *pixel == 0));
        assert_eq!((window[16], window[47]), (100 << 16, 250));
        let mut same = vec![0; 4 * 2];
        fit(&picture, &mut same, (4, 2));
        assert_eq!(same, [100 << 16; 7].into_iter().chain([250]).collect::<Vec<u32>>());
    }

    #[test]
    fn words_stand_below_and_wrap() {
        // Five letters fit: four lines.
        let mut window = vec![0x00ff_ffff; 100 * 120];
        words("one two three four", &mut window, (100, 120));
        let (above, below) = window.split_at((120 - 4 * LINE_PX) * 100);
        assert!(above.iter().all(|pixel| *pixel == 0x00ff_ffff));
        for line in below.chunks(LINE_PX * 100) {
            assert!(line.contains(&0x00e6_e6e6) && line.contains(&0x003f_3f3f));
        }
    }
}
