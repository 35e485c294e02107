//! Which views take part in a frame at all: few, such that together they see as much as can be seen, and kept from frame to frame.
//!
//! Every view that speaks anywhere costs its fit, and neighbouring views show much the same. They are taken greedily, each for what it
//! adds (the cover of a set by submodular gain; Nemhauser, Wolsey and Fisher 1978, DOI 10.1007/BF01588971): a place counts less with
//! every view that sees it clean already.

use rayon::prelude::*;

use crate::stages::specularity_substitution::sight::{PLACES_AT_ONCE, Place, Views};

/// At most so many views can take part.
pub const MOST_MEMBERS: usize = 64;

/// A view that sees a place at this penalty is of no use for it, rad-like.
const USELESS_PENALTY: f32 = 0.8;
/// What a hazy sight is worth against a clean one.
const WORTH_OF_HAZE: f32 = 0.15;
/// What the next sight of a place is worth against the one before.
const WORTH_OF_NEXT: f32 = 0.4;
/// A member of the last frame's ensemble is worth so much more: what is shown must not flicker.
const LOYALTY: f32 = 1.15;

/// The views that take part in a frame; keeps its memory.
#[derive(Debug, Default)]
pub struct Ensemble {
    members: Vec<u16>,
    former: Vec<u16>,
    /// Per view, per place: what the view's sight of it is worth.
    worth: Vec<f32>,
    /// Per place: how much it still counts.
    weight: Vec<f32>,
}

impl Ensemble {
    /// Indices of the views, ascending.
    pub fn members(&self) -> &[u16] {
        &self.members
    }

    /// Forget the last frame.
    pub fn forget(&mut self) {
        self.members.clear();
    }

    /// Choose at most `limit` views for the places that stand for the holes of a frame.
    pub fn gather(&mut self, views: &Views<'_>, places: &[Place], limit: usize) {
        std::mem::swap(&mut self.members, &mut self.former);
        self.members.clear();
        self.weight.clear();
        self.weight.resize(places.len(), 1.0);
        self.worth.clear();
        self.worth.resize(places.len() * views.full.len(), 0.0);
        self.worth
            .par_chunks_mut(places.len().max(1))
            .zip(0..views.full.len() as u16)
            .for_each(|(worth, view)| {
                for (worth, places) in worth.chunks_mut(PLACES_AT_ONCE).zip(places.chunks(PLACES_AT_ONCE)) {
                    let sights = views.look(view, places);
                    for (bit, (worth, &place)) in worth.iter_mut().zip(places).enumerate() {
                        if sights.seen >> bit & 1 != 0 {
                            let of_haze = if sights.clean >> bit & 1 != 0 { 1.0 } else { WORTH_OF_HAZE };
                            *worth = of_haze * (1.0 - views.penalty(view, place) / USELESS_PENALTY).max(0.0);
                        }
                    }
                }
            });
        while self.members.len() < limit.min(MOST_MEMBERS) {
            let Some(best) = self.best_addition(views.full.len()) else {
                break;
            };
            self.members.push(best);
            let sights = self.worth.chunks(places.len().max(1)).nth(best.into()).unwrap_or_default();
            for (weight, &worth) in self.weight.iter_mut().zip(sights) {
                *weight *= 1.0 - (1.0 - WORTH_OF_NEXT) * worth;
            }
        }
        self.members.sort_unstable();
    }

    /// The view that adds most; `None` when none adds anything.
    fn best_addition(&self, views: usize) -> Option<u16> {
        let mut best = None;
        let mut most = 0.0;
        for (view, worth) in (0..views as u16).zip(self.worth.chunks(self.weight.len().max(1))) {
            if self.members.contains(&view) {
                continue;
            }
            let adds = sum_of_products(worth, &self.weight);
            let adds = if self.former.contains(&view) { LOYALTY * adds } else { adds };
            if adds > most {
                (best, most) = (Some(view), adds);
            }
        }
        best
    }
}

fn sum_of_products(a: &[f32], b: &[f32]) -> f32 {
    let mut lanes = [0.0_f32; 8];
    for (a, b) in a.chunks(8).zip(b.chunks(8)) {
        for ((lane, a), b) in lanes.iter_mut().zip(a).zip(b) {
            *lane += a * b;
        }
    }
    lanes.iter().sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::stages::specularity_substitution::example::{DEPTH, Example};

    /// Eight views on a line, and places over the picture; view 6 alone sees the first place.
    fn example() -> (Example, Vec<Place>) {
        let moves: Vec<_> = (0..8).map(|i| (2.0 * i as f32 - 7.0, 0.0)).collect();
        let mut example = Example::new(&moves, [1.0; 3], (0.0, 0.0));
        let places: Vec<Place> = (0..6)
            .map(|i| Place {
                x: 120.0 + 40.0 * i as f32,
                y: 120.0,
                depth: DEPTH,
            })
            .collect();
        let vantages = example.vantages();
        for (view, vantage) in vantages.iter().enumerate().filter(|(view, _)| *view != 6) {
            let (u, v, _) = vantage.unwrap().mapping.apply(places[0].x, places[0].y, DEPTH);
            let confidence = &mut example.light_field.views[view].confidence;
            for y in v as usize - 4..v as usize + 5 {
                confidence.row_mut(y)[u as usize - 4..u as usize + 5].fill(0);
            }
        }
        example.look_again();
        (example, places)
    }

    #[test]
    fn the_only_view_that_sees_a_place_takes_part_and_the_limit_holds() {
        let (example, places) = example();
        let vantages = example.vantages();
        let views = example.views(&vantages);
        let mut ensemble = Ensemble::default();
        for limit in [2, 3, 5] {
            ensemble.gather(&views, &places, limit);
            assert_eq!(ensemble.members().len(), limit);
            assert!(ensemble.members().contains(&6), "{:?}", ensemble.members());
            assert!(ensemble.members().is_sorted());
        }
    }

    #[test]
    fn members_stay_unless_another_view_is_clearly_better() {
        let (example, places) = example();
        let vantages = example.vantages();
        let views = example.views(&vantages);
        let mut ensemble = Ensemble::default();
        ensemble.gather(&views, &places, 3);
        let before = ensemble.members().to_vec();
        // A little to the side: what is best by a hair changes.
        let moved: Vec<Place> = places.iter().map(|p| Place { x: p.x + 2.0, ..*p }).collect();
        ensemble.gather(&views, &moved, 3);
        assert_eq!(ensemble.members(), before);
    }
}
