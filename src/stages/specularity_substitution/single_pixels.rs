//! Specular pixels that none of the chosen views sees clean, and who does: what a view sees between two lobes may be a pixel or two wide.

use crate::stages::specularity_substitution::ensemble::MOST_MEMBERS;
use crate::stages::specularity_substitution::scene::Scene;
use crate::stages::specularity_substitution::sight::{PLACES_AT_ONCE, Place, Views};

/// At most so many views speak for the single pixels of a block.
pub const MOST_ADDITIONS: usize = 3;

/// A block has no more pixels than this, whatever the picture's width.
const MOST_PIXELS: usize = 576;

/// The members that see clean what is specular in a block and what none of those who are `heard`, a bit for each, sees clean.
pub fn needed(scene: &Scene<'_>, views: &Views<'_>, members: &[u16], heard: u64, block: usize) -> [Option<u8>; MOST_ADDITIONS] {
    let mut chosen = [None; MOST_ADDITIONS];
    let side = scene.grid.block();
    let (left, top) = (block % scene.grid.blocks().0 * side, block / scene.grid.blocks().0 * side);
    let (mut unseen, mut count) = ([Place::default(); MOST_PIXELS], 0);
    for y in top..(top + side).min(scene.grid.height) {
        for x in left..(left + side).min(scene.grid.width) {
            if scene.distance.at(x, y) == 0 && scene.forbidden.at(x, y) == 0 && count < MOST_PIXELS {
                let depth = scene.depth_at(x, y);
                if depth > 0.0 {
                    unseen[count] = Place {
                        x: x as f32,
                        y: y as f32,
                        depth,
                    };
                    count += 1;
                }
            }
        }
    }
    let mut rest = 0;
    for begin in (0..count).step_by(PLACES_AT_ONCE) {
        let places = &unseen[begin..(begin + PLACES_AT_ONCE).min(count)];
        let (mut clean, all) = (0, u64::MAX >> (PLACES_AT_ONCE - places.len()));
        for member in (0..members.len()).filter(|member| heard >> member & 1 != 0) {
            clean |= views.look(members[member], places).clean;
            if clean == all {
                break;
            }
        }
        for k in (0..places.len()).filter(|k| clean >> k & 1 == 0) {
            unseen[rest] = unseen[begin + k];
            rest += 1;
        }
    }
    if rest == 0 {
        return chosen;
    }
    // More than can be asked for at once are thinned out.
    let step = rest.div_ceil(PLACES_AT_ONCE);
    let mut places = [Place::default(); PLACES_AT_ONCE];
    let asked = rest.div_ceil(step);
    for (place, unseen) in places.iter_mut().zip(unseen[..rest].iter().step_by(step)) {
        *place = *unseen;
    }
    let places = &places[..asked];
    let mut clean = [0_u64; MOST_MEMBERS];
    for member in (0..members.len()).filter(|member| heard >> member & 1 == 0) {
        clean[member] = views.look(members[member], places).clean;
    }
    let mut wanted = u64::MAX >> (PLACES_AT_ONCE - asked);
    for chosen in &mut chosen {
        let worth =
            |member: usize| (clean[member] & wanted).count_ones() as f32 / (0.1 + views.penalty(members[member], places[0]));
        let best = (0..members.len()).max_by(|&a, &b| worth(a).total_cmp(&worth(b)));
        let Some(best) = best.filter(|&best| worth(best) > 0.0) else {
            break;
        };
        *chosen = Some(best as u8);
        wanted &= !clean[best];
    }
    chosen
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::stages::specularity_substitution::grid::Grid;

    #[test]
    fn a_block_has_no_more_pixels_than_are_kept() {
        for width in 320..1440 {
            let side = Grid::over((width, width / 2)).block();
            assert!(side * side <= MOST_PIXELS, "{width}");
        }
    }
}
