//! Which views take part in a frame at all: few, such that together they see as much as can be seen, and kept from frame to frame.
//!
//! Every view that speaks anywhere costs its fit, and neighbouring views show much the same. They are taken greedily, each for what it
//! adds (the cover of a set by submodular gain; Nemhauser, Wolsey and Fisher 1978, DOI 10.1007/BF01588971): a place counts less with
//! every view that sees it clean already.

use rayon::prelude::*;

use crate::stages::specularity_substitution::scene::Scene;
use crate::stages::specularity_substitution::sight::{Place, Sight, Vantage};

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
    pub fn gather(&mut self, scene: &Scene<'_>, vantages: &[Option<Vantage>], places: &[Place], limit: usize) {
        std::mem::swap(&mut self.members, &mut self.former);
        self.members.clear();
        self.weight.clear();
        self.weight.resize(places.len(), 1.0);
        self.worth.clear();
        self.worth.resize(places.len() * vantages.len(), 0.0);
        let views = &scene.light_field.views;
        self.worth
            .par_chunks_mut(places.len().max(1))
            .zip(vantages)
            .zip(views)
            .for_each(|((worth, vantage), view)| {
                let Some(vantage) = vantage else { return };
                for (worth, &place) in worth.iter_mut().zip(places) {
                    let appeal = 1.0 - vantage.penalty(view, place) / USELESS_PENALTY;
                    if appeal > 0.0 {
                        *worth = appeal
                            * match vantage.sight(view, place) {
                                Sight::Unseen => 0.0,
                                Sight::Hazy => WORTH_OF_HAZE,
                                Sight::Clean => 1.0,
                            };
                    }
                }
            });
        while self.members.len() < limit.min(MOST_MEMBERS) {
            let Some(best) = self.best_addition(vantages.len()) else {
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
