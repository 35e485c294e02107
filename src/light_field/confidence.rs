//! How much each pixel of a view may speak.

use rayon::prelude::*;

use crate::image::buffer::{Image, Mask, Rgb8};
use crate::image::specularity::{Settings, SpecularityDetector};

/// A pixel whose darkest channel rises this far above its surroundings shows the lamp: the mirror image adds white light.
const RISE_LEVELS: f32 = 26.0;
/// Clipped in all channels.
const CLIPPED: u8 = 236;
/// Surroundings reach this far, as a share of the picture's width.
const SURROUNDINGS: f32 = 0.03;
/// Silent within this distance of a specularity: its haze begins before the detector sees it, px of a 960 px wide picture.
const SILENT_PX: f32 = 4.0;
/// Full voice from this distance on.
const FULL_PX: f32 = 9.0;
/// Darker than this in every channel is the endoscope's black surround, not tissue.
const BLACK: u8 = 10;

/// True for a colour of the endoscope's black surround.
pub(super) fn is_black(pixel: Rgb8) -> bool {
    pixel.iter().all(|&level| level < BLACK)
}

/// 0 on specularities, out of the image field and in the black; a ramp around them; 255 elsewhere. `field` is 0 out of the
/// image field.
pub fn confidence_of(image: &Image<Rgb8>, field: &Mask) -> Mask {
    let (width, height) = image.size();
    let scale = (width as f32 / 960.0).max(0.25);
    let dark: Vec<f32> = image.pixels().iter().map(|p| f32::from(p[0].min(p[1]).min(p[2]))).collect();
    let radius = ((SURROUNDINGS * width as f32) as usize).max(2);
    // Two rounds: what rises in the first does not lift the surroundings of the second.
    let mut surroundings = box_mean(&dark, width, height, radius);
    let tamed: Vec<f32> = dark.iter().zip(&surroundings).map(|(&v, &s)| v.min(s + 6.0)).collect();
    surroundings = box_mean(&tamed, width, height, radius);
    let (mut shining, mut steel) = (Image::filled(0, 0, 0), Image::filled(0, 0, 0));
    SpecularityDetector::new(&Settings::default()).detect(image, Some(field), &mut shining, &mut steel);
    let mut silent: Vec<f32> = (0..dark.len())
        .map(|i| {
            let pixel = image.pixels()[i];
            // What is replaced by a view must never be steel, and a view is one of many: either test silences it.
            let marked = shining.pixels()[i] != 0 || steel.pixels()[i] != 0;
            let specular = marked || dark[i] > surroundings[i] + RISE_LEVELS || pixel.iter().all(|&v| v >= CLIPPED);
            let outside = field.pixels()[i] == 0 || is_black(pixel);
            if specular || outside { 0.0 } else { 1e6 }
        })
        .collect();
    chamfer(&mut silent, width, height);
    let (from, to) = (SILENT_PX * scale, FULL_PX * scale);
    let voice = silent
        .iter()
        .map(|d| (((d - from) / (to - from)).clamp(0.0, 1.0) * 255.0) as u8)
        .collect();
    Image::from_vec(width, height, voice).unwrap_or_else(|| field.clone())
}

/// Distance to the nearest 0, in place (two passes; within 8 % of Euclid).
fn chamfer(distance: &mut [f32], width: usize, height: usize) {
    let diagonal = std::f32::consts::SQRT_2;
    let mut relax = |x: usize, y: usize, steps: [(isize, isize, f32); 4]| {
        let mut best = distance[y * width + x];
        for (dx, dy, cost) in steps {
            let (u, v) = (x as isize + dx, y as isize + dy);
            if u >= 0 && v >= 0 && u < width as isize && v < height as isize {
                best = best.min(distance[v as usize * width + u as usize] + cost);
            }
        }
        distance[y * width + x] = best;
    };
    for y in 0..height {
        for x in 0..width {
            relax(x, y, [(-1, 0, 1.0), (0, -1, 1.0), (-1, -1, diagonal), (1, -1, diagonal)]);
        }
    }
    for y in (0..height).rev() {
        for x in (0..width).rev() {
            relax(x, y, [(1, 0, 1.0), (0, 1, 1.0), (1, 1, diagonal), (-1, 1, diagonal)]);
        }
    }
}

/// Mean over a square window, cut at the border.
fn box_mean(values: &[f32], width: usize, height: usize, radius: usize) -> Vec<f32> {
    let mut across = vec![0.0_f32; values.len()];
    across
        .par_chunks_mut(width)
        .zip(values.par_chunks(width))
        .for_each(|(out, row)| {
            let mut sum: f64 = row[..radius.min(width)].iter().map(|&v| f64::from(v)).sum();
            for x in 0..width {
                if x + radius < width {
                    sum += f64::from(row[x + radius]);
                }
                if x > radius {
                    sum -= f64::from(row[x - radius - 1]);
                }
                let count = (x + radius + 1).min(width) - x.saturating_sub(radius);
                out[x] = (sum / count as f64) as f32;
            }
        });
    let mut out = vec![0.0_f32; values.len()];
    let mut sums = vec![0.0_f64; width];
    for y in 0..radius.min(height) {
        for x in 0..width {
            sums[x] += f64::from(across[y * width + x]);
        }
    }
    for y in 0..height {
        let count = (y + radius + 1).min(height) - y.saturating_sub(radius);
        for x in 0..width {
            if y + radius < height {
                sums[x] += f64::from(across[(y + radius) * width + x]);
            }
            if y > radius {
                sums[x] -= f64::from(across[(y - radius - 1) * width + x]);
            }
            out[y * width + x] = (sums[x] / count as f64) as f32;
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_white_spot_on_red_tissue_is_silent_and_its_ring_half() {
        let mut image = Image::filled(240, 160, [150, 70, 60]);
        for y in 75..85 {
            for x in 100..112 {
                image.set(x, y, [235, 215, 210]);
            }
        }
        let confidence = confidence_of(&image, &Image::filled(240, 160, 255));
        assert_eq!(confidence.at(105, 80), 0);
        assert!((1..255).contains(&confidence.at(113, 80)));
        assert_eq!(confidence.at(130, 80), 255);
        assert_eq!(confidence.at(20, 20), 255);
    }

    #[test]
    fn white_gauze_as_a_whole_is_no_specularity() {
        let image = Image::filled(240, 160, [205, 200, 195]);
        let confidence = confidence_of(&image, &Image::filled(240, 160, 255));
        assert!(confidence.pixels().iter().all(|&c| c == 255));
    }

    #[test]
    fn means_of_windows() {
        let values: Vec<f32> = (0..35).map(|v| v as f32).collect();
        let mean = box_mean(&values, 7, 5, 1);
        assert!((mean[8] - 8.0).abs() < 1e-5 && (mean[0] - 4.0).abs() < 1e-5, "{mean:?}");
    }
}
