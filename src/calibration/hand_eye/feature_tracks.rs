//! Places of a scene followed through a video: what a hand-eye calibration without a board looks at.
//!
//! Corners (Shi and Tomasi 1994) are followed from frame to frame by their patch as it first was (Lucas and Kanade 1981, over three
//! sizes of the picture), so that errors do not add up; a track ends where its patch no longer looks the same. What is nearly saturated
//! is not looked at: the lamp's image moves with the lamp.

use rayon::prelude::*;

use crate::camera::intrinsics::Pixel;
use crate::image::buffer::{Image, Mask, Rgb8};
use crate::image::corners::{CornerChoice, corners};
use crate::image::gradient::gray_from_rgb;
use crate::image::patch::{PATCH_RADIUS_PX, Template};
use crate::image::pyramid::{Pyramid, eroded};

/// Sizes of the picture.
const LEVELS: usize = 3;
/// Gray levels that tissue has; above, the lamp shows.
const USABLE_LEVELS: std::ops::RangeInclusive<f32> = 12.0..=225.0;
/// What is nearer than this to what is not usable is not usable either, px.
const MARGIN_PX: usize = 3;
/// Correlation below which a patch is not the same any more.
const SAME: f32 = 0.88;
/// Tracks that are kept going.
const TRACKS: usize = 220;
/// Farthest from where a patch is looked for on each size, px of that size.
const REACH_PX: f32 = 6.0;
const STEPS: usize = 12;

/// One place of the scene.
#[derive(Clone, Debug, Default)]
pub struct FeatureTrack {
    /// In which views it was seen, and where.
    pub places: Vec<(usize, Pixel)>,
}

struct Live {
    /// Finest first; a coarse one is missing where too little of it is usable.
    templates: Vec<Option<Template>>,
    at: [f32; 2],
    moved: [f32; 2],
    track: FeatureTrack,
}

/// Follows corners through a video, frame by frame.
#[derive(Default)]
pub struct FeatureTracker {
    live: Vec<Live>,
    ended: Vec<FeatureTrack>,
}

impl std::fmt::Debug for FeatureTracker {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "FeatureTracker({} live, {} ended)", self.live.len(), self.ended.len())
    }
}

impl FeatureTracker {
    /// The next frame; if it is a view, its number: places are noted and new corners taken up only in views.
    pub fn next(&mut self, image: &Image<Rgb8>, view: Option<usize>) {
        let gray = gray_from_rgb(image);
        let mut valid: Mask = Image::filled(gray.width(), gray.height(), 0);
        for (valid, level) in valid.pixels_mut().iter_mut().zip(gray.pixels()) {
            *valid = if USABLE_LEVELS.contains(level) { 255 } else { 0 };
        }
        let pyramid = Pyramid::new(gray, eroded(&valid, MARGIN_PX), LEVELS);
        let followed: Vec<Result<Live, FeatureTrack>> = (std::mem::take(&mut self.live).into_par_iter())
            .map(|mut live| if live.follow(&pyramid) { Ok(live) } else { Err(live.track) })
            .collect();
        for outcome in followed {
            match outcome {
                Ok(live) => self.live.push(live),
                Err(track) => self.ended.push(track),
            }
        }
        let Some(view) = view else { return };
        for live in &mut self.live {
            live.track.places.push((view, live.pixel()));
        }
        self.take_up(&pyramid, view);
    }

    /// All tracks that two views or more share.
    pub fn tracks(self) -> Vec<FeatureTrack> {
        let live = self.live.into_iter().map(|live| live.track);
        let all = self.ended.into_iter().chain(live);
        all.filter(|track| track.places.len() > 1).collect()
    }

    /// New corners where none is followed.
    fn take_up(&mut self, pyramid: &Pyramid, view: usize) {
        let choice = CornerChoice {
            cells: 20,
            per_cell: 1,
            min_strength: 0.2,
            margin: 2 * PATCH_RADIUS_PX,
        };
        let mut found = corners(&pyramid.levels[0], &pyramid.valid[0], &choice);
        found.sort_by(|a, b| b.strength.total_cmp(&a.strength));
        let apart = (1.5 * PATCH_RADIUS_PX as f32).powi(2);
        for corner in found {
            if self.live.len() >= TRACKS {
                break;
            }
            let taken = |live: &Live| (live.at[0] - corner.x).powi(2) + (live.at[1] - corner.y).powi(2) < apart;
            if self.live.iter().any(taken) {
                continue;
            }
            let templates: Vec<Option<Template>> = (pyramid.levels.iter().zip(&pyramid.valid).enumerate())
                .map(|(level, (image, valid))| {
                    let scale = 0.5_f32.powi(level as i32);
                    Template::new(image, valid, corner.x * scale, corner.y * scale)
                })
                .collect();
            if templates.first().is_none_or(Option::is_none) {
                continue;
            }
            let mut live = Live {
                templates,
                at: [corner.x, corner.y],
                moved: [0.0; 2],
                track: FeatureTrack::default(),
            };
            live.track.places.push((view, live.pixel()));
            self.live.push(live);
        }
    }
}

impl Live {
    fn pixel(&self) -> Pixel {
        Pixel {
            x: f64::from(self.at[0]),
            y: f64::from(self.at[1]),
        }
    }

    /// Find it in the next frame, coarse to fine; false where it cannot be found.
    fn follow(&mut self, pyramid: &Pyramid) -> bool {
        const UPRIGHT: [[f32; 2]; 2] = [[1.0, 0.0], [0.0, 1.0]];
        let mut at = [self.at[0] + self.moved[0], self.at[1] + self.moved[1]];
        for level in (0..pyramid.levels.len()).rev() {
            let Some(template) = self.templates.get(level).and_then(Option::as_ref) else {
                continue;
            };
            let scale = 0.5_f32.powi(level as i32);
            let start = (at[0] * scale, at[1] * scale);
            let found = template.locate(&pyramid.levels[level], &pyramid.valid[level], UPRIGHT, start, REACH_PX, STEPS);
            match found {
                Some(found) if found.zncc >= SAME || (level > 0 && found.zncc > 0.5) => at = [found.x / scale, found.y / scale],
                // A coarse patch may reach over what cannot be seen; the fine one must be found.
                _ if level > 0 => {}
                _ => return false,
            }
        }
        self.moved = [at[0] - self.at[0], at[1] - self.at[1]];
        self.at = at;
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A smooth random pattern shifted by so much.
    fn picture(shift: [f64; 2]) -> Image<Rgb8> {
        let mut image = Image::filled(320, 240, [0; 3]);
        for y in 0..240 {
            for x in 0..320 {
                let (u, v) = (x as f64 - shift[0], y as f64 - shift[1]);
                let wave = (0.31 * u + 0.17 * v).sin() + (0.23 * v - 0.11 * u).sin() + (0.047 * u * 1.7 + 0.29 * v).cos();
                let level = (110.0 + 30.0 * wave).round() as u8;
                // A lamp's image that stays where it is.
                let lamp = (x as f64 - 160.0).hypot(y as f64 - 120.0) < 12.0;
                image.set(x, y, if lamp { [255; 3] } else { [level; 3] });
            }
        }
        image
    }

    #[test]
    fn places_are_followed_to_a_few_hundredths_of_a_pixel() {
        let mut tracker = FeatureTracker::default();
        for frame in 0..9 {
            let shift = [2.3 * f64::from(frame), -1.1 * f64::from(frame)];
            tracker.next(&picture(shift), (frame % 4 == 0).then_some(frame as usize / 4));
        }
        let tracks = tracker.tracks();
        assert!(tracks.len() > 30, "{}", tracks.len());
        let mut errors: Vec<f64> = Vec::new();
        for track in &tracks {
            for pair in track.places.windows(2) {
                let views = (pair[1].0 - pair[0].0) as f64;
                let (dx, dy) = (pair[1].1.x - pair[0].1.x, pair[1].1.y - pair[0].1.y);
                errors.push((dx - 9.2 * views).hypot(dy + 4.4 * views));
            }
        }
        errors.sort_by(f64::total_cmp);
        // Rounding to whole levels: 0.29 levels against slopes of some 6 levels a px over 200 pixels and more.
        assert!(errors[errors.len() / 2] < 0.05, "{}", errors[errors.len() / 2]);
        assert!(errors[errors.len() * 95 / 100] < 0.2, "{}", errors[errors.len() * 95 / 100]);
    }
}
