//! The picture replaced where it is brighter than what was measured.

use rayon::prelude::*;

use crate::frame::provenance_code;
use crate::image::buffer::{Image, Rgb8};
use crate::stages::specularity_substitution::blend::{Canvas, PLAIN};
use crate::stages::specularity_substitution::scene::Scene;
use crate::stages::specularity_substitution::settings::Settings;

/// Below this share of the new colour a pixel stays as it was.
const LEAST_SHARE: f32 = 0.12;

/// At the end of its reach a replacement wants so much more evidence, levels.
const FAR_DOUBT_LEVELS: f32 = 4.0;

/// So much more evidence is wanted for every level by which the surroundings are darker than what was measured.
const AGAINST_WEIGHT: f32 = 1.5;
/// The same for what the detector marked.
const AGAINST_DETECTED: f32 = 0.4;

/// Planes to fill, all of the picture's size.
#[derive(Debug)]
pub struct Planes<'a> {
    /// The new picture; holds the old one.
    pub image: &'a mut Image<Rgb8>,
    /// Provenance codes; hold what was detected.
    pub code: &'a mut Image<u8>,
    /// Loudest view of each replaced pixel.
    pub view: &'a mut Image<u16>,
    /// How sure each replaced pixel is.
    pub confidence: &'a mut Image<u8>,
}

/// Replace, row by row.
pub fn replace(scene: &Scene<'_>, canvas: &Canvas, settings: &Settings, planes: Planes<'_>) {
    let width = scene.image.width();
    (planes.image.pixels_mut().par_chunks_mut(width))
        .zip(planes.code.pixels_mut().par_chunks_mut(width))
        .zip(planes.view.pixels_mut().par_chunks_mut(width))
        .zip(planes.confidence.pixels_mut().par_chunks_mut(width))
        .enumerate()
        .with_min_len(16)
        .for_each(|(y, (((image, code), view), confidence))| {
            let beliefs = canvas.belief.row(y);
            for (x, &belief) in beliefs.iter().enumerate() {
                if belief <= PLAIN {
                    continue;
                }
                let share = share_of(scene, canvas, settings, x, y);
                if share < LEAST_SHARE {
                    // Looked at, and found to be tissue.
                    code[x] = provenance_code::UNTOUCHED;
                    continue;
                }
                let new = canvas.color.at(x, y);
                image[x] = std::array::from_fn(|c| {
                    let (old, new) = (f32::from(image[x][c]), f32::from(new[c]));
                    (old + share * (new - old) + 0.5) as u8
                });
                code[x] = provenance_code::LIGHT_FIELD;
                view[x] = canvas.source.at(x, y);
                confidence[x] = belief;
            }
        });
}

/// How much of the old pixel goes, 0…1.
fn share_of(scene: &Scene<'_>, canvas: &Canvas, settings: &Settings, x: usize, y: usize) -> f32 {
    // Noise does not decide: the mean over 3 × 3 pixels.
    let excess = mean_of_neighbours(canvas, x, y).max(0.6 * canvas.excess.at(x, y));
    let near = (1.0 - f32::from(scene.distance.at(x, y)) / f32::from(scene.reach)).clamp(0.0, 1.0);
    let against = if scene.distance.at(x, y) == 0 {
        AGAINST_DETECTED
    } else {
        AGAINST_WEIGHT
    };
    let doubt = FAR_DOUBT_LEVELS * (1.0 - 2.0 * near).max(0.0) + against * canvas.against[scene.grid.cell_at(x, y)];
    let (low, high) = (settings.excess_low_levels + doubt, settings.excess_high_levels + doubt);
    let brighter = ((excess - low) / (high - low)).clamp(0.0, 1.0);
    smooth(brighter) * smooth((4.0 * near).min(1.0))
}

fn smooth(t: f32) -> f32 {
    t * t * (3.0 - 2.0 * t)
}

fn mean_of_neighbours(canvas: &Canvas, x: usize, y: usize) -> f32 {
    let (width, height) = canvas.belief.size();
    let (mut sum, mut count) = (0.0, 0.0);
    for v in y.saturating_sub(1)..(y + 2).min(height) {
        let columns = x.saturating_sub(1)..(x + 2).min(width);
        for (&belief, &excess) in canvas.belief.row(v)[columns.clone()]
            .iter()
            .zip(&canvas.excess.row(v)[columns])
        {
            if belief > 0 {
                sum += excess;
                count += 1.0;
            }
        }
    }
    sum / f32::max(count, 1.0)
}
