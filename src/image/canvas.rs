//! Lines, areas and words on a picture: what the plots of reports are drawn with.

use crate::image::buffer::{Image, Rgb8};

/// Size of a letter's cell, px: letters are three by five cells.
const CELL: usize = 4;

/// A picture that is drawn on; what lies outside is not drawn. Coordinates are those of pixel corners: (0, 0) is the upper left pixel.
#[derive(Debug)]
pub struct Canvas {
    /// What was drawn so far.
    pub image: Image<Rgb8>,
}

impl Canvas {
    /// An empty one.
    pub fn new(width: usize, height: usize, background: Rgb8) -> Self {
        Self {
            image: Image::filled(width, height, background),
        }
    }

    /// One pixel.
    pub fn dot(&mut self, x: f64, y: f64, color: Rgb8) {
        if x >= 0.0 && y >= 0.0 && (x as usize) < self.image.width() && (y as usize) < self.image.height() {
            self.image.set(x as usize, y as usize, color);
        }
    }

    /// An area of `width` × `height` pixels whose upper left is at `x`, `y`.
    pub fn fill(&mut self, x: f64, y: f64, width: usize, height: usize, color: Rgb8) {
        for v in 0..height {
            for u in 0..width {
                self.dot(x + u as f64, y + v as f64, color);
            }
        }
    }

    /// A line one pixel wide.
    pub fn line(&mut self, from: [f64; 2], to: [f64; 2], color: Rgb8) {
        let (dx, dy) = (to[0] - from[0], to[1] - from[1]);
        let steps = dx.abs().max(dy.abs()).ceil().clamp(1.0, 1e4);
        for step in 0..=steps as usize {
            let share = step as f64 / steps;
            self.dot(from[0] + share * dx, from[1] + share * dy, color);
        }
    }

    /// A diagonal cross nine pixels wide.
    pub fn cross(&mut self, at: [f64; 2], color: Rgb8) {
        self.line([at[0] - 4.0, at[1] - 4.0], [at[0] + 4.0, at[1] + 4.0], color);
        self.line([at[0] - 4.0, at[1] + 4.0], [at[0] + 4.0, at[1] - 4.0], color);
    }

    /// Words in capitals, 20 px high and 16 px a letter, whose upper left is at `x`, `y`; letters without a glyph are blanks.
    pub fn text(&mut self, x: usize, y: usize, words: &str, color: Rgb8) {
        for (place, letter) in words.chars().enumerate() {
            let Some((_, rows)) = GLYPHS.iter().find(|(known, _)| *known == letter.to_ascii_uppercase()) else {
                continue;
            };
            for (v, row) in rows.iter().enumerate() {
                for u in (0..3).filter(|u| row >> (2 - u) & 1 == 1) {
                    let left = x + (place * 4 + u) * CELL;
                    self.fill(left as f64, (y + v * CELL) as f64, CELL, CELL, color);
                }
            }
        }
    }
}

/// From blue over green and yellow to red.
pub fn heat(share: f64) -> Rgb8 {
    const STOPS: [[f64; 3]; 5] = [
        [40.0, 60.0, 160.0],
        [30.0, 150.0, 170.0],
        [90.0, 200.0, 90.0],
        [240.0, 210.0, 60.0],
        [230.0, 50.0, 40.0],
    ];
    let at = share.clamp(0.0, 1.0) * 4.0;
    let low = (at as usize).min(3);
    let part = at - low as f64;
    let mut color = [0; 3];
    for (channel, out) in color.iter_mut().enumerate() {
        *out = (STOPS[low][channel] * (1.0 - part) + STOPS[low + 1][channel] * part).round() as u8;
    }
    color
}

/// Letters of three by five cells, row by row, the left cell the highest bit.
const GLYPHS: [(char, [u8; 5]); 46] = [
    ('0', [7, 5, 5, 5, 7]),
    ('1', [2, 6, 2, 2, 7]),
    ('2', [7, 1, 7, 4, 7]),
    ('3', [7, 1, 7, 1, 7]),
    ('4', [5, 5, 7, 1, 1]),
    ('5', [7, 4, 7, 1, 7]),
    ('6', [7, 4, 7, 5, 7]),
    ('7', [7, 1, 2, 2, 2]),
    ('8', [7, 5, 7, 5, 7]),
    ('9', [7, 5, 7, 1, 7]),
    ('.', [0, 0, 0, 0, 2]),
    (',', [0, 0, 0, 2, 4]),
    ('-', [0, 0, 7, 0, 0]),
    ('+', [0, 2, 7, 2, 0]),
    ('=', [0, 7, 0, 7, 0]),
    ('/', [1, 1, 2, 4, 4]),
    (':', [0, 2, 0, 2, 0]),
    ('%', [5, 1, 2, 4, 5]),
    ('(', [1, 2, 2, 2, 1]),
    (')', [4, 2, 2, 2, 4]),
    ('A', [2, 5, 7, 5, 5]),
    ('B', [6, 5, 6, 5, 6]),
    ('C', [7, 4, 4, 4, 7]),
    ('D', [6, 5, 5, 5, 6]),
    ('E', [7, 4, 6, 4, 7]),
    ('F', [7, 4, 6, 4, 4]),
    ('G', [7, 4, 5, 5, 7]),
    ('H', [5, 5, 7, 5, 5]),
    ('I', [7, 2, 2, 2, 7]),
    ('J', [1, 1, 1, 5, 7]),
    ('K', [5, 5, 6, 5, 5]),
    ('L', [4, 4, 4, 4, 7]),
    ('M', [5, 7, 7, 5, 5]),
    ('N', [6, 5, 5, 5, 5]),
    ('O', [7, 5, 5, 5, 7]),
    ('P', [7, 5, 7, 4, 4]),
    ('Q', [7, 5, 5, 7, 1]),
    ('R', [6, 5, 6, 5, 5]),
    ('S', [7, 4, 7, 1, 7]),
    ('T', [7, 2, 2, 2, 2]),
    ('U', [5, 5, 5, 5, 7]),
    ('V', [5, 5, 5, 5, 2]),
    ('W', [5, 5, 7, 7, 5]),
    ('X', [5, 5, 2, 5, 5]),
    ('Y', [5, 5, 2, 2, 2]),
    ('Z', [7, 1, 2, 4, 7]),
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_lies_outside_is_not_drawn() {
        let mut canvas = Canvas::new(10, 8, [0; 3]);
        canvas.line([-5.0, 4.0], [20.0, 4.0], [9; 3]);
        canvas.fill(8.0, 6.0, 10, 10, [7; 3]);
        canvas.text(7, 7, "x", [1; 3]);
        assert!((0..10).all(|x| canvas.image.at(x, 4) == [9; 3]));
        assert_eq!(canvas.image.at(8, 6), [7; 3]);
        assert_eq!(canvas.image.at(7, 6), [0; 3]);
        assert_eq!(canvas.image.at(7, 7), [1; 3]);
    }

    #[test]
    fn letters_differ() {
        let drawn = |word: &str| {
            let mut canvas = Canvas::new(12, 20, [0; 3]);
            canvas.text(0, 0, word, [1; 3]);
            canvas.image.pixels().to_vec()
        };
        for (i, (a, _)) in GLYPHS.iter().enumerate() {
            for (b, _) in &GLYPHS[i + 1..] {
                // Five rows are too few to tell these.
                if ![('0', 'O'), ('5', 'S')].contains(&(*a, *b)) {
                    assert_ne!(drawn(&a.to_string()), drawn(&b.to_string()), "{a} {b}");
                }
            }
        }
    }
}
