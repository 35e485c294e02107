//! A view drawn as the live camera would see it, over a box of pixels.

use crate::image::buffer::{Image, Rgb8};
use crate::light_field::mapping::Mapping;
use crate::light_field::view::View;
use crate::stages::specularity_substitution::candidates::is_unoccluded;

/// A rectangle of pixels of the live picture.
#[derive(Clone, Copy, Debug, Default)]
pub struct Window {
    /// First column.
    pub left: usize,
    /// First row.
    pub top: usize,
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
}

impl Window {
    /// Number of pixels.
    pub fn area(&self) -> usize {
        self.width * self.height
    }
}

/// One view over a window: colours and how far each may be believed (0 = not seen).
#[derive(Clone, Debug, Default)]
pub struct WarpedView {
    /// Colours, sRGB levels.
    pub color: Vec<[f32; 3]>,
    /// Confidence, 0…1.
    pub confidence: Vec<f32>,
}

impl WarpedView {
    /// Draw `view` for every pixel of `window` that has a depth (`depth[i]` > 0), the live pixel moved by `shift` before it is looked up.
    /// Where `fine` says so the lookup is bicubic (Catmull–Rom), which keeps the tissue's texture; elsewhere bilinear.
    pub fn draw(
        &mut self,
        view: &View,
        mapping: &Mapping,
        window: Window,
        depth: &[f32],
        shift: [f32; 2],
        fine: Option<&[bool]>,
    ) {
        self.color.clear();
        self.color.resize(window.area(), [0.0; 3]);
        self.confidence.clear();
        self.confidence.resize(window.area(), 0.0);
        let (width, height) = view.image.size();
        let (last_x, last_y) = (width as f32 - 2.0, height as f32 - 2.0);
        for row in 0..window.height {
            let y = (window.top + row) as f32 + shift[1];
            let begin = row * window.width;
            for column in 0..window.width {
                let index = begin + column;
                let z = depth[index];
                if z <= 0.0 {
                    continue;
                }
                let (u, v, w) = mapping.apply((window.left + column) as f32 + shift[0], y, z);
                if !(u >= 1.0 && v >= 1.0 && u < last_x && v < last_y) {
                    continue;
                }
                let (x0, y0) = (u as usize, v as usize);
                let (fx, fy) = (u - x0 as f32, v - y0 as f32);
                let corner = y0 * width + x0;
                let c = view.confidence.pixels();
                // Where any of the four is dazzled the mixture is.
                let least = c[corner].min(c[corner + 1]).min(c[corner + width]).min(c[corner + width + 1]);
                if least == 0 || !is_unoccluded(view.depth.pixels()[corner], w) {
                    continue;
                }
                self.confidence[index] = f32::from(least) / 255.0;
                self.color[index] = if fine.is_some_and(|f| f[index]) {
                    bicubic(&view.image, x0, y0, fx, fy)
                } else {
                    bilinear(&view.image, x0, y0, fx, fy)
                };
            }
        }
    }
}

#[inline]
fn bilinear(image: &Image<Rgb8>, x: usize, y: usize, fx: f32, fy: f32) -> [f32; 3] {
    let (upper, lower) = (&image.row(y)[x..x + 2], &image.row(y + 1)[x..x + 2]);
    std::array::from_fn(|c| {
        let top = f32::from(upper[0][c]) + (f32::from(upper[1][c]) - f32::from(upper[0][c])) * fx;
        let bottom = f32::from(lower[0][c]) + (f32::from(lower[1][c]) - f32::from(lower[0][c])) * fx;
        top + (bottom - top) * fy
    })
}

/// Catmull and Rom's cubic (Keys 1981, a = −½).
#[inline]
fn bicubic(image: &Image<Rgb8>, x: usize, y: usize, fx: f32, fy: f32) -> [f32; 3] {
    let (wx, wy) = (cubic_weights(fx), cubic_weights(fy));
    let mut sum = [0.0_f32; 3];
    for (row, wy) in wy.iter().enumerate() {
        let pixels = &image.row(y + row - 1)[x - 1..x + 3];
        for (pixel, wx) in pixels.iter().zip(wx) {
            let weight = wx * wy;
            for (sum, &channel) in sum.iter_mut().zip(pixel) {
                *sum += weight * f32::from(channel);
            }
        }
    }
    sum
}

#[inline]
fn cubic_weights(t: f32) -> [f32; 4] {
    let (t2, t3) = (t * t, t * t * t);
    [
        0.5 * (-t + 2.0 * t2 - t3),
        0.5 * (2.0 - 5.0 * t2 + 3.0 * t3),
        0.5 * (t + 4.0 * t2 - 3.0 * t3),
        0.5 * (t3 - t2),
    ]
}
