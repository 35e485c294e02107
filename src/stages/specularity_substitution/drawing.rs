//! One block of the picture: its pixels that may show the lamp, the views that speak there drawn over them, and blended.

use crate::image::color::luma;
use crate::image::wide;
use crate::light_field::mapping::is_unoccluded;
use crate::light_field::view::View;
use crate::stages::specularity_substitution::drawn::{Blended, Drawn};
use crate::stages::specularity_substitution::grid::Sums;
use crate::stages::specularity_substitution::live::Live;
use crate::stages::specularity_substitution::lookup::{Strip, cubic_across, cubic_down, split};
use crate::stages::specularity_substitution::scene::Scene;
use crate::stages::specularity_substitution::small_view::SmallView;
use crate::stages::specularity_substitution::speaker::{Block, Chosen, Speaker, brightened, find_speakers, halves, mixed};
use crate::stages::specularity_substitution::spots::{CLEAN, FindSpots, Spot, Spots};
use crate::stages::specularity_substitution::view_fit::part;

/// Working memory of one block at a time.
#[derive(Debug, Default)]
pub struct Bench {
    /// What there is to draw.
    pub spots: Spots,
    speakers: Vec<Speaker>,
    drawn: Drawn,
    /// Indices of the spots that are not settled.
    open: Vec<u32>,
    sights: Vec<Sight>,
    strips: Vec<Strip>,
    blended: Vec<Option<Blended>>,
}

impl Bench {
    /// Spots that somebody saw, and what the views say of them.
    pub fn blended(&self) -> impl Iterator<Item = (Spot, Blended)> {
        let pairs = self.spots.doubtful.iter().zip(&self.blended);
        pairs.filter_map(|(spot, blended)| Some((*spot, (*blended)?)))
    }

    /// Index of the view that was loudest.
    pub fn view_of(&self, blended: &Blended) -> usize {
        self.speakers[blended.speaker].view
    }

    /// Blend the views over block (i, j).
    pub fn blend(&mut self, scene: &Scene<'_>, live: &Live, chosen: &Chosen<'_>, (i, j): (usize, usize)) {
        find_speakers(scene, chosen, (i, j), &mut self.speakers);
        wide::run(FindSpots {
            scene,
            holes: &live.holes,
            chosen,
            speakers: &self.speakers,
            place: (i, j),
            found: &mut self.spots,
        });
        self.blended.clear();
        if !self.spots.doubtful.is_empty() {
            self.drawn.clear(self.spots.doubtful.len(), self.speakers.len());
            self.open.clear();
            self.open.extend(0..self.spots.doubtful.len() as u32);
            for index in 0..self.speakers.len() {
                if self.open.is_empty() {
                    break;
                }
                wide::run(Draw {
                    view: &scene.light_field.views[self.speakers[index].view],
                    small: &chosen.small_views[self.speakers[index].view],
                    block: Block::of(scene.grid, i, j),
                    index,
                    bench: self,
                });
            }
            self.drawn.blend(self.spots.doubtful.len(), &mut self.blended);
        }
    }
}

/// One speaker drawn over the spots that are not settled.
struct Draw<'a> {
    view: &'a View,
    small: &'a SmallView,
    block: Block,
    index: usize,
    bench: &'a mut Bench,
}

impl wide::Kernel for Draw<'_> {
    #[inline(always)]
    fn run(self) {
        let Self {
            view,
            small,
            block,
            index,
            bench,
        } = self;
        let Bench {
            speakers,
            spots: Spots { doubtful: spots, .. },
            drawn,
            open,
            sights,
            strips,
            ..
        } = bench;
        sights.clear();
        find_sights(&speakers[index], (spots, open), view, small, block, sights);
        if strips.len() < sights.len() {
            strips.resize(sights.len(), [0.0; 16]);
        }
        // First all strips, then all colours: each a short loop over memory that fills vector registers.
        for (strip, sight) in strips.iter_mut().zip(&*sights) {
            cubic_down(&view.image, sight.x, sight.y, sight.fy, strip);
        }
        for (strip, sight) in strips.iter_mut().zip(&*sights) {
            let color = cubic_across(strip, sight.fx);
            strip[..4].copy_from_slice(&color);
        }
        let begin = index * drawn.pitch;
        for (strip, sight) in strips.iter().zip(&*sights) {
            let spot = &mut spots[sight.spot];
            let confidence = f32::from(sight.confidence) / 255.0;
            let color = brightened([strip[0], strip[1], strip[2]], &sight.field);
            let brightness = luma(color);
            if sight.confidence >= CLEAN {
                spot.clean += 1;
                spot.luma += brightness;
            }
            let place = begin + sight.spot;
            for (plane, channel) in drawn.color.iter_mut().zip(color) {
                plane[place] = channel;
            }
            drawn.luma[place] = brightness;
            // Clean sights outshout hazy ones by far more than the confidences alone.
            drawn.weight[place] = sight.loud * confidence * confidence;
            drawn.confidence[place] = confidence;
            drawn.residual[place] = sight.field[part::RESIDUAL];
        }
        open.retain(|&spot| !spots[spot as usize].is_settled());
    }
}

/// Where a view shows a spot.
#[derive(Clone, Copy, Debug)]
struct Sight {
    /// Index of the spot.
    spot: usize,
    /// The pixel of the view, and the way to the next.
    x: usize,
    y: usize,
    fx: f32,
    fy: f32,
    /// There, mm.
    depth: f32,
    field: Sums,
    loud: f32,
    /// The least of the pixels around.
    confidence: u8,
}

/// Where a speaker's view shows the spots that are not settled, if it does.
#[inline(always)]
fn find_sights(
    speaker: &Speaker,
    (spots, open): (&[Spot], &[u32]),
    view: &View,
    small: &SmallView,
    block: Block,
    sights: &mut Vec<Sight>,
) {
    let (width, height) = view.image.size();
    let (last_x, last_y) = (width as f32 - 2.0, height as f32 - 3.0);
    let confidences = view.confidence.pixels();
    let (mut row, mut columns) = (u16::MAX, [[0.0; 8]; 3]);
    for &k in open {
        let spot = &spots[k as usize];
        let (x, y) = (f32::from(spot.x), f32::from(spot.y));
        let (fx, fy) = block.share_of(x, y);
        if spot.y != row {
            (row, columns) = (spot.y, speaker.columns_at(fy));
        }
        let (first, t) = halves(fx);
        let field = mixed(&columns[first], &columns[first + 1], t);
        let loud = speaker.loudness_at(fx, fy) * field[part::FIT];
        let (u, v, depth) = (speaker.mapping).apply(x + field[part::SHIFT], y + field[part::SHIFT + 1], spot.depth);
        if !(loud > 0.0 && depth > 0.0 && u >= 1.0 && v >= 1.0 && u < last_x && v < last_y) {
            continue;
        }
        let ((x, fx), (y, fy)) = (split(u), split(v));
        fetch(view, small, x, y);
        sights.push(Sight {
            spot: k as usize,
            x,
            y,
            fx,
            fy,
            depth,
            field,
            loud,
            confidence: 0,
        });
    }
    sights.retain_mut(|sight| {
        let corner = sight.y * width + sight.x;
        // Where any of the four is dazzled the mixture is.
        let (upper, lower) = (
            &confidences[corner..corner + 2],
            &confidences[corner + width..corner + width + 2],
        );
        sight.confidence = upper[0].min(upper[1]).min(lower[0]).min(lower[1]);
        sight.confidence > 0 && is_unoccluded(small.depth_at(sight.x, sight.y), sight.depth)
    });
}

/// Ask for all that a spot at pixel (x, y) of a view needs.
#[inline(always)]
fn fetch(view: &View, small: &SmallView, x: usize, y: usize) {
    let (width, bytes) = (view.image.width(), view.image.as_bytes());
    let corner = y * width + x;
    wide::fetch(view.confidence.pixels(), corner);
    wide::fetch(view.confidence.pixels(), corner + width);
    for row in 0..4 {
        wide::fetch(bytes, 3 * (corner + row * width) - 3 * (width + 1));
    }
    small.fetch_depth(x, y);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::stages::specularity_substitution::camera_blending::CameraBlending;
    use crate::stages::specularity_substitution::ensemble::MOST_MEMBERS;
    use crate::stages::specularity_substitution::example::{Example, HOLE, in_hole};
    use crate::stages::specularity_substitution::settings::Settings;
    use crate::stages::specularity_substitution::view_fit::{Comparison, ViewFit, Workbench};

    /// Spots and what was blended of them in the block of the hole's middle.
    fn blended(example: &Example) -> Bench {
        let (scene, vantages, settings) = (example.scene(), example.vantages(), Settings::default());
        let views = example.views(&vantages);
        let (mut blending, mut live) = (CameraBlending::default(), Live::default());
        live.look(&scene);
        blending.choose(&scene, &live.holes, &views, MOST_MEMBERS);
        let block = scene.grid.block();
        let (i, j) = (HOLE.0 / block, HOLE.1 / block);
        let mut fits = Vec::new();
        for (small, vantage) in example.small_views.iter().zip(&vantages) {
            let mut fit = ViewFit::default();
            fit.begin(scene.grid);
            fit.need_around(&scene, &live, i, j);
            let comparison = Comparison {
                grid: scene.grid,
                scale: scene.scale,
                live: &live,
                view: small,
                mapping: &vantage.unwrap().small,
                settings: &settings,
            };
            fit.measure(&comparison, &mut Workbench::default());
            fits.push(fit);
        }
        let chosen = Chosen {
            corners: blending.corners(),
            fits: &fits,
            small_views: &example.small_views,
            vantages: &vantages,
        };
        let mut bench = Bench::default();
        bench.blend(&scene, &live, &chosen, (i, j));
        bench
    }

    #[test]
    fn under_the_lamp_the_tissue_is_found_and_tissue_is_not_drawn() {
        let example = Example::new(&[(4.0, 0.0), (-4.0, 1.0), (1.0, 5.0), (0.0, -5.0)], [1.0; 3], (0.0, 0.0));
        let bench = blended(&example);
        assert!(
            bench
                .blended()
                .filter(|(spot, _)| in_hole(spot.x.into(), spot.y.into()))
                .count()
                > 30
        );
        for (spot, blended) in bench.blended() {
            let truth = example.truth(spot.x.into(), spot.y.into());
            for (found, truth) in blended.color.into_iter().zip(truth) {
                assert!((found - truth).abs() < 3.0, "{spot:?}: {:?} for {truth}", blended.color);
            }
            assert!(blended.confidence > 0.95);
        }
    }

    #[test]
    fn a_view_that_is_dazzled_unnoticed_is_not_heard() {
        let mut example = Example::new(&[(4.0, 0.0), (-4.0, 1.0), (1.0, 5.0), (0.0, -5.0)], [1.0; 3], (0.0, 0.0));
        // View 0 shows the lamp at the hole and believes itself.
        let (u, v, _) = example.vantages()[0].unwrap().mapping.apply(
            HOLE.0 as f32,
            HOLE.1 as f32,
            crate::stages::specularity_substitution::example::DEPTH,
        );
        let image = &mut example.light_field.views[0].image;
        for y in v as usize - 8..v as usize + 9 {
            for pixel in &mut image.row_mut(y)[u as usize - 8..u as usize + 9] {
                *pixel = pixel.map(|c| c.saturating_add(60));
            }
        }
        example.look_again();
        let bench = blended(&example);
        let mut seen = 0;
        for (spot, blended) in bench.blended().filter(|(spot, _)| in_hole(spot.x.into(), spot.y.into())) {
            let truth = luma(example.truth(spot.x.into(), spot.y.into()));
            assert!(
                (luma(blended.color) - truth).abs() < 3.0,
                "{spot:?}: {:?} for {truth}",
                blended.color
            );
            seen += 1;
        }
        assert!(seen > 30);
    }
}
