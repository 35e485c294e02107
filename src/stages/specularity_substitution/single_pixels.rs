//! Specular pixels that none of the chosen views sees clean, and who does: what a view sees between two lobes may be a pixel or two wide.

use crate::stages::specularity_substitution::ensemble::MOST_MEMBERS;
use crate::stages::specularity_substitution::scene::Scene;
use crate::stages::specularity_substitution::sight::{PLACES_AT_ONCE, Place, Views};

/// At most so many views speak for the single pixels of a block.
pub const MOST_ADDITIONS: usize = 3;

/// A block has no more pixels than this, whatever the picture's width.
const MOST_PIXELS: usize = 576;

/// The members that see clean what is specular in block (i, j) and what none of those who are `heard`, a bit for each, sees clean.
pub fn needed(
    scene: &Scene<'_>,
    views: &Views<'_>,
    (members, heard): (&[u16], u64),
    (i, j): (usize, usize),
) -> [Option<u8>; MOST_ADDITIONS] {
    let mut chosen = [None; MOST_ADDITIONS];
    let mut pixels = [Place::default(); MOST_PIXELS];
    let specular = find_specular(scene, (i, j), &mut pixels);
    let unseen = keep_unseen(views, (members, heard), &mut pixels[..specular]);
    if unseen == 0 {
        return chosen;
    }
    // More than can be asked for at once are thinned out.
    let step = unseen.div_ceil(PLACES_AT_ONCE);
    let mut places = [Place::default(); PLACES_AT_ONCE];
    for (place, pixel) in places.iter_mut().zip(pixels[..unseen].iter().step_by(step)) {
        *place = *pixel;
    }
    let places = &places[..unseen.div_ceil(step)];
    // Per member, the places that it sees clean, and what hearing it costs.
    let mut offers = [(0_u64, 1.0_f32); MOST_MEMBERS];
    for (member, (clean, cost)) in offers[..members.len()].iter_mut().enumerate() {
        if heard >> member & 1 == 0 {
            *clean = views.look(members[member], places).clean;
            *cost = 0.1 + views.penalty(members[member], places[0]);
        }
    }
    let mut wanted = u64::MAX >> (PLACES_AT_ONCE - places.len());
    for chosen in &mut chosen {
        let worth = |member: usize| (offers[member].0 & wanted).count_ones() as f32 / offers[member].1;
        let best = (0..members.len()).max_by(|&a, &b| worth(a).total_cmp(&worth(b)));
        let Some(best) = best.filter(|&best| worth(best) > 0.0) else {
            break;
        };
        *chosen = Some(best as u8);
        wanted &= !offers[best].0;
    }
    chosen
}

/// The specular pixels of block (i, j) that may be replaced, and how many they are.
fn find_specular(scene: &Scene<'_>, (i, j): (usize, usize), pixels: &mut [Place; MOST_PIXELS]) -> usize {
    let side = scene.grid.block();
    let mut count = 0;
    for y in j * side..((j + 1) * side).min(scene.grid.height) {
        for x in i * side..((i + 1) * side).min(scene.grid.width) {
            if scene.distance.at(x, y) != 0 || scene.forbidden.at(x, y) != 0 || count == MOST_PIXELS {
                continue;
            }
            let depth = scene.depth_at(x, y);
            if depth > 0.0 {
                pixels[count] = Place {
                    x: x as f32,
                    y: y as f32,
                    depth,
                };
                count += 1;
            }
        }
    }
    count
}

/// Bring to the front the pixels that none of those who are heard sees clean, and say how many they are.
fn keep_unseen(views: &Views<'_>, (members, heard): (&[u16], u64), pixels: &mut [Place]) -> usize {
    let mut unseen = 0;
    for begin in (0..pixels.len()).step_by(PLACES_AT_ONCE) {
        let places = &pixels[begin..(begin + PLACES_AT_ONCE).min(pixels.len())];
        let (mut clean, all) = (0, u64::MAX >> (PLACES_AT_ONCE - places.len()));
        for member in (0..members.len()).filter(|member| heard >> member & 1 != 0) {
            clean |= views.look(members[member], places).clean;
            if clean == all {
                break;
            }
        }
        for k in (0..places.len()).filter(|k| clean >> k & 1 == 0) {
            pixels[unseen] = pixels[begin + k];
            unseen += 1;
        }
    }
    unseen
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
