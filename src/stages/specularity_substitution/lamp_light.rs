//! What is replaced must have lost the lamp's light: white, and a good deal of it. A patch that changes slightly, or in another colour, is
//! tissue that the light field shows a little differently; it is not replaced at all.
//!
//! Light adds up before the camera encodes it: what shows the lamp is there, in each channel, tissue lit a little better or worse plus
//! white light (dichromatic model, Shafer 1985). Over a patch noise is averaged away, and the two amounts tell the lamp from tissue that
//! the light field shows darker than it is, and what neither explains tells it from pale fat, which rises yellow from the red around it.

use rayon::prelude::*;

use crate::image::buffer::Image;
use crate::image::color::{fast_linear, luma};
use crate::image::components::Components;
use crate::light_field::lamp_share::length;
use crate::stages::specularity_substitution::blend::Canvas;
use crate::stages::specularity_substitution::scene::Scene;

/// Patches that lose less light at their bright parts are left, levels of luma.
const LEAST_LOSS_LEVELS: f32 = 8.0;
/// White light must be this share of what is lost. On rendered scenes 95 % of the lamp's patches have more than 0.9, and 95 % of others
/// less than 0.7.
const LEAST_LAMP_SHARE: f32 = 0.7;
/// At most this share of the change may be neither the tissue's light nor white; the lamp's patches have less than 0.03.
const MOST_OTHER_SHARE: f32 = 0.05;
/// Noise of a pixel's change, share of white.
const NOISE: f32 = 0.01;
/// Tissue so near to grey (sine of the angle) cannot be told from white light.
const LEAST_SINE: f32 = 0.05;

const CHANGED: u8 = 255;

/// From this level on a channel may be clipped, and the change's colour says nothing.
const CLIPPED_LEVEL: f32 = 245.0;
/// Patches that are all but clipped throughout are the lamp's whatever their colour: share of the weight that is not clipped.
const LEAST_COLORED_SHARE: f32 = 0.02;

/// Sums over a patch, each pixel weighed by the luma that it loses.
#[derive(Clone, Copy, Debug, Default)]
struct Change {
    pixels: f32,
    weight: f32,
    /// Of the loss in luma.
    loss: f32,
    /// Of pixels that are not clipped.
    colored: f32,
    /// Of their loss, in linear light.
    light: [f32; 3],
    /// Of what they show now, in linear light.
    tissue: [f32; 3],
}

impl Change {
    fn add(&mut self, old: [f32; 3], new: [f32; 3]) {
        let lost: [f32; 3] = std::array::from_fn(|c| old[c] - new[c]);
        let weight = luma(lost).max(0.0);
        self.pixels += 1.0;
        self.weight += weight;
        self.loss += weight * weight;
        if old.iter().any(|&level| level >= CLIPPED_LEVEL) {
            return;
        }
        self.colored += weight;
        for c in 0..3 {
            let tissue = fast_linear(new[c] / 255.0);
            self.light[c] += weight * (fast_linear(old[c] / 255.0) - tissue);
            self.tissue[c] += weight * tissue;
        }
    }

    /// Whether the lamp explains it.
    fn is_the_lamps(&self) -> bool {
        let weight = self.weight.max(1e-6);
        if self.loss / weight < LEAST_LOSS_LEVELS {
            return false;
        }
        if self.colored < LEAST_COLORED_SHARE * weight {
            return true;
        }
        let [light, tissue] = [self.light, self.tissue].map(|sum| sum.map(|v| v / self.colored));
        let (lamp, other) = lamp_and_other(light, tissue);
        lamp > LEAST_LAMP_SHARE * luma(light) && other < MOST_OTHER_SHARE * length(light) + NOISE / self.pixels.max(1.0).sqrt()
    }
}

/// How much of `change` is white light, and how much neither that nor the `tissue`'s own; least squares.
fn lamp_and_other(change: [f32; 3], tissue: [f32; 3]) -> (f32, f32) {
    let dot = |a: [f32; 3], b: [f32; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    let (tt, tw) = (dot(tissue, tissue), tissue.iter().sum::<f32>());
    let (ct, cw) = (dot(change, tissue), change.iter().sum::<f32>());
    let determinant = 3.0 * tt - tw * tw;
    let (lit, lamp) = if determinant <= 3.0 * tt * LEAST_SINE * LEAST_SINE {
        (0.0, cw / 3.0)
    } else {
        ((3.0 * ct - tw * cw) / determinant, (tt * cw - tw * ct) / determinant)
    };
    let other = length(std::array::from_fn(|c| change[c] - lit * tissue[c] - lamp));
    (lamp, other)
}

/// Finds patches that are not the lamp's; keeps its memory.
#[derive(Debug)]
pub struct LampLight {
    replaced: Image<u8>,
    patches: Components,
    changes: Vec<Change>,
}

impl Default for LampLight {
    fn default() -> Self {
        Self {
            replaced: Image::filled(0, 0, 0),
            patches: Components::default(),
            changes: Vec::new(),
        }
    }
}

impl LampLight {
    /// Set to 0 the `shares` (of 255, of the new colour; below `least` nothing changes) of patches that the lamp does not explain.
    pub fn leave_others(&mut self, scene: &Scene<'_>, canvas: &Canvas, shares: &mut Image<u8>, least: u8) {
        let (width, height) = shares.size();
        if self.replaced.size() != (width, height) {
            self.replaced.resize(width, height, 0);
        }
        let rows = self
            .replaced
            .pixels_mut()
            .par_chunks_mut(width.max(1))
            .zip(shares.pixels().par_chunks(width.max(1)));
        rows.with_min_len(16).for_each(|(replaced, shares)| {
            for (replaced, &share) in replaced.iter_mut().zip(shares) {
                *replaced = if share >= least { CHANGED } else { 0 };
            }
        });
        self.patches.label(&self.replaced);
        self.changes.clear();
        self.changes.resize(self.patches.regions().len(), Change::default());
        for run in self.patches.runs() {
            let columns = run.begin as usize..run.end as usize;
            let change = &mut self.changes[run.label as usize];
            let (old, new) = (scene.image.row(run.y as usize), canvas.color.row(run.y as usize));
            for (old, new) in old[columns.clone()].iter().zip(&new[columns]) {
                change.add(old.map(f32::from), new.map(f32::from));
            }
        }
        let changes = &self.changes;
        self.patches.paint(shares, 0, |label, _| !changes[label].is_the_lamps());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TISSUE: [f32; 3] = [150.0, 60.0, 62.0];

    /// A patch of red tissue, half of whose pixels rise by `rise` and half by half of it.
    fn patch(rise: [f32; 3]) -> Change {
        patch_on(TISSUE, rise)
    }

    fn patch_on(tissue: [f32; 3], rise: [f32; 3]) -> Change {
        let mut change = Change::default();
        for i in 0..60 {
            let part = if i % 2 == 0 { 1.0 } else { 0.5 };
            change.add(std::array::from_fn(|c| tissue[c] + part * rise[c]), tissue);
        }
        change
    }

    /// Coded levels of light added in linear light.
    fn shone(light: f32) -> [f32; 3] {
        TISSUE.map(|v| 255.0 * ((v / 255.0).powf(2.2) + light).min(1.0).powf(1.0 / 2.2) - v)
    }

    #[test]
    fn white_light_is_the_lamps_weak_or_clipped() {
        for light in [0.08, 0.2, 0.5, 1.0, 2.0] {
            assert!(patch(shone(light)).is_the_lamps(), "{light}");
        }
    }

    #[test]
    fn a_clipped_core_does_not_speak_of_colour() {
        // A gleam on a yellow gall bladder: red and green are at their end, blue goes on.
        let tissue = [205.0, 160.0, 105.0];
        let mut gleam = patch_on(tissue, [22.0, 27.0, 33.0]);
        for _ in 0..60 {
            gleam.add([255.0, 255.0, 250.0], tissue);
        }
        assert!(gleam.is_the_lamps());
        let mut clipped = Change::default();
        clipped.add([255.0; 3], tissue);
        assert!(clipped.is_the_lamps());
    }

    #[test]
    fn fat_and_slight_changes_and_darker_tissue_are_not() {
        // From red tissue to pale fat.
        assert!(!patch([50.0, 120.0, 68.0]).is_the_lamps());
        assert!(!patch_on([120.0, 77.0, 61.0], [28.0, 41.0, 34.0]).is_the_lamps());
        assert!(!patch(shone(0.012)).is_the_lamps());
        assert!(patch(shone(0.04)).is_the_lamps());
        // A gall bladder that the light field shows a tenth too dark.
        assert!(!patch_on([124.0, 91.0, 71.0], [26.0, 26.0, 22.0]).is_the_lamps());
    }

    #[test]
    fn on_grey_tissue_the_change_must_be_grey() {
        let (mut white, mut yellow) = (Change::default(), Change::default());
        for _ in 0..50 {
            white.add([190.0, 189.0, 188.0], [120.0, 118.0, 117.0]);
            yellow.add([190.0, 180.0, 140.0], [120.0, 118.0, 117.0]);
        }
        assert!(white.is_the_lamps());
        assert!(!yellow.is_the_lamps());
    }
}
