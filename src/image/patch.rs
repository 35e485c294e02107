//! Finding a small patch of one picture in another, to a fraction of a pixel.
//!
//! Lucas and Kanade 1981, in the inverse form of Baker and Matthews, "Lucas–Kanade 20 years on", 2004
//! (doi:10.1023/B:VISI.0000011205.11775.fd): the slopes are those of the template, so they are taken once. The shape of the patch
//! in the target (a 2×2 warp) is known from geometry; only its place is sought. Gain and offset of brightness are projected out of
//! both residual and slopes, because the lamp rides on the camera; masked pixels weigh nothing (a mask must reach one pixel farther than what it hides, since interpolation does).

use crate::image::buffer::{Image, Mask};

/// Half the side of a patch, px of its pyramid level.
pub const PATCH_RADIUS_PX: usize = 8;
const SIDE: usize = 2 * PATCH_RADIUS_PX + 1;
const AREA: usize = SIDE * SIDE;
/// A patch with fewer valid pixels in common than this share says nothing.
const MIN_COMMON_SHARE: f32 = 0.6;
/// Steps below this end the search, px.
const CONVERGED_PX: f32 = 0.01;

/// The values and slopes of a patch, taken around a place of a picture.
#[derive(Clone, Debug)]
pub struct Template {
    values: [f32; AREA],
    along_x: [f32; AREA],
    along_y: [f32; AREA],
    valid: [bool; AREA],
}

/// What a search found.
#[derive(Clone, Copy, Debug)]
pub struct PatchMatch {
    /// Column of the patch's centre, px.
    pub x: f32,
    /// Row of the patch's centre, px.
    pub y: f32,
    /// Normalized cross-correlation of template and target, −1 to 1.
    pub zncc: f32,
}

/// Linear between the four neighbours; `None` outside the picture.
#[inline]
pub fn bilinear(image: &Image<f32>, x: f32, y: f32) -> Option<f32> {
    let (width, height) = image.size();
    if !(x >= 0.0 && y >= 0.0 && x < (width - 1) as f32 && y < (height - 1) as f32) {
        return None;
    }
    let (left, top) = (x as usize, y as usize);
    let (u, v) = (x - left as f32, y - top as f32);
    let at = top * width + left;
    let pixels = image.pixels();
    let (a, b) = (&pixels[at..at + 2], &pixels[at + width..at + width + 2]);
    let (above, below) = (a[0] + u * (a[1] - a[0]), b[0] + u * (b[1] - b[0]));
    Some(above + v * (below - above))
}

fn is_valid(mask: &Mask, x: f32, y: f32) -> bool {
    mask.at((x + 0.5) as usize, (y + 0.5) as usize) != 0
}

impl Template {
    /// The patch around (`x`, `y`); `None` if too little of it is valid.
    pub fn new(image: &Image<f32>, valid: &Mask, x: f32, y: f32) -> Option<Self> {
        let mut template = Self {
            values: [0.0; AREA],
            along_x: [0.0; AREA],
            along_y: [0.0; AREA],
            valid: [false; AREA],
        };
        let mut count = 0;
        for (row, dy) in (-(PATCH_RADIUS_PX as isize)..=PATCH_RADIUS_PX as isize).enumerate() {
            for (column, dx) in (-(PATCH_RADIUS_PX as isize)..=PATCH_RADIUS_PX as isize).enumerate() {
                let (u, v) = (x + dx as f32, y + dy as f32);
                let (Some(centre), Some(left), Some(right), Some(up), Some(down)) = (
                    bilinear(image, u, v),
                    bilinear(image, u - 1.0, v),
                    bilinear(image, u + 1.0, v),
                    bilinear(image, u, v - 1.0),
                    bilinear(image, u, v + 1.0),
                ) else {
                    continue;
                };
                if !is_valid(valid, u, v) {
                    continue;
                }
                let i = row * SIDE + column;
                template.values[i] = centre;
                template.along_x[i] = 0.5 * (right - left);
                template.along_y[i] = 0.5 * (down - up);
                template.valid[i] = true;
                count += 1;
            }
        }
        (count as f32 >= MIN_COMMON_SHARE * AREA as f32).then_some(template)
    }

    /// Search around `start` in `image` for the patch, deformed by `warp` (offset in the target from offset in the template);
    /// `None` if the search leaves the picture, goes farther than `reach` px, or the patch has no texture.
    pub fn locate(
        &self,
        image: &Image<f32>,
        valid: &Mask,
        warp: [[f32; 2]; 2],
        start: (f32, f32),
        reach: f32,
        steps: usize,
    ) -> Option<PatchMatch> {
        let [[a, b], [c, d]] = warp;
        let determinant = a * d - b * c;
        if !(determinant.abs() > 0.05 && determinant.abs() < 20.0) {
            return None;
        }
        let (mut x, mut y) = start;
        let mut previous = None;
        for _ in 0..steps.max(1) {
            let normal = self.compare(image, valid, warp, x, y)?;
            let zncc = normal.zncc();
            previous = Some(PatchMatch { x, y, zncc });
            let (sx, sy) = normal.step()?;
            // Slopes were taken in template coordinates: the step there, carried into the target.
            let (dx, dy) = (a * sx + b * sy, c * sx + d * sy);
            x += dx;
            y += dy;
            if !((x - start.0).abs() <= reach && (y - start.1).abs() <= reach) {
                return None;
            }
            if dx * dx + dy * dy < CONVERGED_PX * CONVERGED_PX {
                break;
            }
        }
        previous.map(|p| PatchMatch { x, y, ..p })
    }

    /// How well the patch fits at one place, without searching.
    pub fn zncc_at(&self, image: &Image<f32>, valid: &Mask, warp: [[f32; 2]; 2], at: (f32, f32)) -> Option<f32> {
        self.compare(image, valid, warp, at.0, at.1).map(|n| n.zncc())
    }

    fn compare(&self, image: &Image<f32>, valid: &Mask, warp: [[f32; 2]; 2], x: f32, y: f32) -> Option<Sums> {
        let [[a, b], [c, d]] = warp;
        let mut sums = Sums::default();
        for row in 0..SIDE {
            let dy = row as f32 - PATCH_RADIUS_PX as f32;
            for column in 0..SIDE {
                let i = row * SIDE + column;
                if !self.valid[i] {
                    continue;
                }
                let dx = column as f32 - PATCH_RADIUS_PX as f32;
                let (u, v) = (x + a * dx + b * dy, y + c * dx + d * dy);
                let Some(value) = bilinear(image, u, v) else { continue };
                if is_valid(valid, u, v) {
                    sums.add(self.values[i], value, self.along_x[i], self.along_y[i]);
                }
            }
        }
        (sums.n >= MIN_COMMON_SHARE * AREA as f32).then_some(sums)
    }
}

/// First and second moments over the common pixels: t template, i target, x and y template slopes.
#[derive(Clone, Copy, Debug, Default)]
struct Sums {
    n: f32,
    t: f32,
    i: f32,
    x: f32,
    y: f32,
    tt: f32,
    ii: f32,
    ti: f32,
    xx: f32,
    xy: f32,
    yy: f32,
    xt: f32,
    yt: f32,
    xi: f32,
    yi: f32,
}

impl Sums {
    #[inline]
    fn add(&mut self, t: f32, i: f32, x: f32, y: f32) {
        // Around mid-gray, so that f32 sums keep their digits.
        let (t, i) = (t - 128.0, i - 128.0);
        self.n += 1.0;
        self.t += t;
        self.i += i;
        self.x += x;
        self.y += y;
        self.tt += t * t;
        self.ii += i * i;
        self.ti += t * i;
        self.xx += x * x;
        self.xy += x * y;
        self.yy += y * y;
        self.xt += x * t;
        self.yt += y * t;
        self.xi += x * i;
        self.yi += y * i;
    }

    fn covariance(&self, product: f32, a: f32, b: f32) -> f32 {
        product - a * b / self.n
    }

    fn zncc(&self) -> f32 {
        let (tt, ii) = (
            self.covariance(self.tt, self.t, self.t),
            self.covariance(self.ii, self.i, self.i),
        );
        if tt < 1e-3 || ii < 1e-3 {
            0.0
        } else {
            self.covariance(self.ti, self.t, self.i) / (tt * ii).sqrt()
        }
    }

    /// The Gauss–Newton step in template coordinates with offset (means) and gain (the direction t) projected out.
    fn step(&self) -> Option<(f32, f32)> {
        let tt = self.covariance(self.tt, self.t, self.t);
        if tt < 1e-3 {
            return None;
        }
        let ti = self.covariance(self.ti, self.t, self.i);
        let gain = ti / tt;
        if gain < 0.1 {
            return None;
        }
        let (xt, yt) = (
            self.covariance(self.xt, self.x, self.t),
            self.covariance(self.yt, self.y, self.t),
        );
        let xx = self.covariance(self.xx, self.x, self.x) - xt * xt / tt;
        let xy = self.covariance(self.xy, self.x, self.y) - xt * yt / tt;
        let yy = self.covariance(self.yy, self.y, self.y) - yt * yt / tt;
        // Residual target − gain·template, already free of t: its product with the slopes.
        let rx = self.covariance(self.xi, self.x, self.i) - gain * xt;
        let ry = self.covariance(self.yi, self.y, self.i) - gain * yt;
        let determinant = xx * yy - xy * xy;
        if determinant.is_nan() || determinant <= 1e-6 * (xx + yy) * (xx + yy) {
            return None;
        }
        let scale = -1.0 / (determinant * gain);
        Some((scale * (yy * rx - xy * ry), scale * (xx * ry - xy * rx)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn wave(x: f32, y: f32) -> f32 {
        128.0
            + 40.0 * (0.31 * x + 0.12 * y).sin()
            + 30.0 * (0.23 * y - 0.17 * x).cos()
            + 10.0 * (0.5 * x).sin() * (0.41 * y).cos()
    }

    fn picture(f: impl Fn(f32, f32) -> f32) -> Image<f32> {
        let mut image = Image::filled(96, 80, 0.0);
        for y in 0..80 {
            for x in 0..96 {
                image.set(x, y, f(x as f32, y as f32));
            }
        }
        image
    }

    #[test]
    fn a_shifted_dimmed_turned_patch_is_found_behind_a_mask() {
        let valid = Image::filled(96, 80, 255u8);
        let template = Template::new(&picture(wave), &valid, 48.0, 40.0).unwrap();
        // Target pixel q shows the template's pixel 48 + A⁻¹(q − centre).
        let warp = [[1.05f32, 0.08], [-0.06, 0.97]];
        let (cx, cy) = (50.3, 37.6);
        let det = warp[0][0] * warp[1][1] - warp[0][1] * warp[1][0];
        let mut target = picture(|x, y| {
            let (dx, dy) = (x - cx, y - cy);
            let u = (warp[1][1] * dx - warp[0][1] * dy) / det;
            let v = (-warp[1][0] * dx + warp[0][0] * dy) / det;
            0.6 * wave(48.0 + u, 40.0 + v) + 12.0
        });
        let mut mask = valid.clone();
        for y in 29..37 {
            for x in 43..53 {
                mask.set(x, y, 0);
                if (30..36).contains(&y) && (44..52).contains(&x) {
                    target.set(x, y, 255.0);
                }
            }
        }
        let found = template.locate(&target, &mask, warp, (48.0, 40.0), 8.0, 20).unwrap();
        assert!((found.x - cx).abs() < 0.05 && (found.y - cy).abs() < 0.05, "{found:?}");
        assert!(found.zncc > 0.99);
    }

    #[test]
    fn a_flat_patch_is_nowhere() {
        let flat = Image::filled(96, 80, 90.0f32);
        let valid = Image::filled(96, 80, 255u8);
        let template = Template::new(&flat, &valid, 48.0, 40.0).unwrap();
        assert!(
            template
                .locate(&flat, &valid, [[1.0, 0.0], [0.0, 1.0]], (48.0, 40.0), 8.0, 10)
                .is_none()
        );
    }
}
