//! What is replaced must have lost the lamp's light: white, and a good deal of it. A patch that changes slightly, or in another colour, is
//! tissue that the light field shows a little differently; it is not replaced at all.
//!
//! A picture that shows the lamp is, in each channel, tissue lit a little better or worse plus white light (dichromatic model, Shafer
//! 1985). What of the change lies in neither of these two directions of colour space is neither. Pixel by pixel noise hides it, over
//! a patch it tells pale fat, which rises yellow from the red around it, from the lamp.

use rayon::prelude::*;

use crate::image::buffer::Image;
use crate::image::color::luma;
use crate::image::components::Components;
use crate::stages::specularity_substitution::blend::Canvas;
use crate::stages::specularity_substitution::scene::Scene;

/// Patches that lose less light at their bright parts are left, levels of luma.
const LEAST_LOSS_LEVELS: f32 = 12.0;
/// At most this share of the change may be of another colour. On rendered scenes 97 % of the lamp's patches have less than 0.06, three in
/// four of others more than 0.07; lamps are not quite white.
const MOST_OTHER_SHARE: f32 = 0.075;
/// Noise of a pixel's change, levels.
const NOISE_LEVELS: f32 = 3.0;
/// Tissue is grey where the sine of its angle to grey is below this; the change must then be grey.
const GREY_SINE: f32 = 0.1;

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
    /// Of their loss in colour.
    color: [f32; 3],
    /// Of their new colour.
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
            self.color[c] += weight * lost[c];
            self.tissue[c] += weight * new[c];
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
        let [color, tissue] = [self.color, self.tissue].map(|sum| sum.map(|v| v / self.colored));
        let noise = NOISE_LEVELS / self.pixels.max(1.0).sqrt();
        other_than_lit_and_white(color, tissue) < MOST_OTHER_SHARE * length(color) + noise
    }
}

/// How much of `change` is neither the `tissue`'s colour nor white.
fn other_than_lit_and_white(change: [f32; 3], tissue: [f32; 3]) -> f32 {
    // Upright on both: tissue × (1, 1, 1).
    let upright = [tissue[1] - tissue[2], tissue[2] - tissue[0], tissue[0] - tissue[1]];
    let size = length(upright);
    if size > GREY_SINE * 3.0_f32.sqrt() * length(tissue) {
        (change[0] * upright[0] + change[1] * upright[1] + change[2] * upright[2]).abs() / size
    } else {
        let mean = (change[0] + change[1] + change[2]) / 3.0;
        length(change.map(|v| v - mean))
    }
}

fn length(v: [f32; 3]) -> f32 {
    (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt()
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
    fn fat_and_slight_changes_are_not() {
        // From red tissue to pale fat.
        assert!(!patch([50.0, 120.0, 68.0]).is_the_lamps());
        assert!(!patch_on([120.0, 77.0, 61.0], [28.0, 41.0, 34.0]).is_the_lamps());
        assert!(!patch([7.0, 7.0, 7.0]).is_the_lamps());
        assert!(patch([24.0, 28.0, 28.0]).is_the_lamps());
    }

    #[test]
    fn on_grey_tissue_the_change_must_be_grey() {
        let mut white = Change::default();
        let mut yellow = Change::default();
        for _ in 0..50 {
            white.add([190.0, 189.0, 188.0], [120.0, 118.0, 117.0]);
            yellow.add([190.0, 180.0, 140.0], [120.0, 118.0, 117.0]);
        }
        assert!(white.is_the_lamps());
        assert!(!yellow.is_the_lamps());
    }
}
