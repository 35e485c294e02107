//! A picture of a white balance: left the target as seen, darkened where it did not count, beside itself corrected; right how far from
//! gray each tenth of the picture stays.

use crate::calibration::color::white::{TENTHS, White, counts};
use crate::calibration::plot::field::Field;
use crate::calibration::plot::style::{BACKGROUND, CAPTION, MARGIN, PANEL_WIDTH, WHITE, round_above};
use crate::image::buffer::{Image, Rgb8};
use crate::image::canvas::{Canvas, heat};
use crate::image::color::{linear_from_srgb, srgb_from_linear};

/// Colors nearer to gray than this are all called gray, ΔE2000: the least that the scale shows.
const LEAST_SCALE: f64 = 1.0;

/// Draw it, with one of the pictures.
pub fn drawn(white: &White, image: &Image<Rgb8>) -> Image<Rgb8> {
    let (left, right, top) = (MARGIN as f64, (2 * MARGIN + PANEL_WIDTH) as f64, (MARGIN + CAPTION) as f64);
    let fields = [left, right].map(|x| Field::new([x, top], image.size()));
    let height = fields[0].height;
    let mut canvas = Canvas::new(2 * PANEL_WIDTH + 3 * MARGIN, height + CAPTION + 2 * MARGIN, BACKGROUND);
    for field in &fields {
        field.ground(&mut canvas);
    }
    let corrected = |pixel: Rgb8| -> Rgb8 {
        std::array::from_fn(|c| {
            let linear = white.gains[c] * linear_from_srgb(f64::from(pixel[c]) / 255.0);
            (255.0 * srgb_from_linear(linear)).round().clamp(0.0, 255.0) as u8
        })
    };
    // Left half of the panel the left half of the picture as seen, right half the right half corrected.
    let (width, tall) = image.size();
    for y in 0..height {
        for x in 0..PANEL_WIDTH {
            let at = |v: usize, of: usize, most: usize| (v * most / of.max(1)).min(most.saturating_sub(1));
            if width == 0 || tall == 0 {
                continue;
            }
            let pixel = image.at(at(x, PANEL_WIDTH, width), at(y, height, tall));
            let shown = if 2 * x < PANEL_WIDTH { pixel } else { corrected(pixel) };
            let shown = if counts(&pixel) { shown } else { shown.map(|level| level / 3) };
            canvas.dot(left + x as f64, top + y as f64, shown);
        }
    }
    canvas.text(MARGIN, MARGIN, "AS SEEN", WHITE);
    let [red, green, blue] = white.gains;
    let words = format!("X {red:.3} {green:.3} {blue:.3}");
    canvas.text(MARGIN + PANEL_WIDTH / 2, MARGIN, &words, WHITE);

    let most = round_above(white.after_tenths.iter().flatten().copied().fold(LEAST_SCALE, f64::max));
    for (place, value) in white.after_tenths.iter().enumerate() {
        let edge = |part: usize, of: usize| part * of / TENTHS;
        let (column, row) = (place % TENTHS, place / TENTHS);
        let (x, y) = (edge(column, PANEL_WIDTH), edge(row, height));
        let color = value.map_or([0; 3], |value| heat(value / most));
        canvas.fill(
            right + x as f64,
            top + y as f64,
            edge(column + 1, PANEL_WIDTH) - x,
            edge(row + 1, height) - y,
            color,
        );
    }
    let words = format!("DE TO GRAY {:.2} BEFORE {:.2} AFTER", white.before, white.after);
    canvas.text(right as usize, MARGIN, &words, WHITE);
    for step in 0..100 {
        canvas.fill(
            right + 590.0 + f64::from(step),
            MARGIN as f64 + 2.0,
            1,
            16,
            heat(f64::from(step) / 99.0),
        );
    }
    canvas.text(right as usize + 570, MARGIN, "0", WHITE);
    canvas.text(right as usize + 700, MARGIN, &format!("{most}"), WHITE);
    canvas.image
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_target_is_gray_after_and_other_light_stands_out() {
        // Red light on one half of the target, and a tenth of the picture that is dark.
        let mut image = Image::filled(200, 100, [140, 120, 100]);
        for y in 0..100 {
            for x in 0..200 {
                if x >= 150 {
                    image.set(x, y, [160, 120, 100]);
                }
                if y < 10 {
                    image.set(x, y, [5; 3]);
                }
            }
        }
        let white = White::measured(&[&image]).unwrap();
        assert!(white.after_tenths[..TENTHS].iter().all(Option::is_none));
        let of_row = &white.after_tenths[5 * TENTHS..6 * TENTHS];
        assert!(of_row[3].unwrap() < 0.5 && of_row[9].unwrap() > 3.0, "{of_row:?}");
        let picture = drawn(&white, &image);
        let at = |x: usize, y: usize| picture.at(x, y);
        let top = MARGIN + CAPTION;
        assert_eq!(at(MARGIN + 100, top + 200), [140, 120, 100]);
        let [red, green, blue] = at(MARGIN + 450, top + 200);
        assert!(red.abs_diff(green) <= 1 && blue.abs_diff(green) <= 1, "{red} {green} {blue}");
        let right = 2 * MARGIN + PANEL_WIDTH;
        assert_eq!(at(right + 40, top + 10), [0; 3]);
        // The worst tenth is near the red end of the scale, the gray ones at its blue end.
        let [red, _, blue] = at(right + 780, top + 200);
        assert!(red > 200 && blue < 100, "{red} {blue}");
        let [red, _, blue] = at(right + 40, top + 200);
        assert!(red < 60 && blue > 150, "{red} {blue}");
    }

    #[test]
    fn nothing_to_draw_is_no_fault() {
        let white = White::measured(&[&Image::filled(20, 10, [140, 120, 100])]).unwrap();
        assert!(drawn(&white, &Image::filled(1, 1, [0; 3])).height() > 0);
    }
}
