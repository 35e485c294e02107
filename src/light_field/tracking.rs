//! First tracks through a survey: corners of some views (anchors), followed from view to view in both directions.
//!
//! The arm's poses and a depth predict where a corner goes; the prediction is off by the arm's noise (some px) and by the error
//! of the depth, so a coarse-to-fine patch search takes over from there. Each search compares with the anchor's own patch, so an
//! error does not add up along a track, and a corner that no longer looks like itself ends its track.
//!
//! Nothing is known of the depth at first. It is found as the one depth at which most corners of some pairs of views land on
//! something similar (a plane sweep on corners alone), in units of the pair's baseline, so that any unit of length will do.

use nalgebra::{Isometry3, Vector2, Vector3};
use rayon::prelude::*;

use crate::camera::intrinsics::Intrinsics;
use crate::image::corners::{CornerChoice, corners};
use crate::image::patch::Template;
use crate::image::pyramid::Pyramid;

/// Depth hypotheses of the sweep.
const DEPTH_STEPS: usize = 48;
/// Search reach at each level, px of the level.
const REACH_PX: f32 = 6.0;
const NO_WARP: [[f32; 2]; 2] = [[1.0, 0.0], [0.0, 1.0]];

/// A scene point as the pictures show it.
#[derive(Clone, Debug)]
pub(crate) struct Track {
    /// The view that lends its patch.
    pub anchor: usize,
    /// Where in the views, px of the working picture; the anchor's own is among them.
    pub observations: Vec<(usize, Vector2<f64>)>,
}

/// How tracks are made.
#[derive(Clone, Copy, Debug)]
pub(crate) struct TrackingChoice {
    /// Corners per anchor and their spread.
    pub corners: CornerChoice,
    /// Every how many views is an anchor.
    pub anchor_step: usize,
    /// How many views a corner is followed to either side.
    pub reach_views: usize,
    /// Least similarity.
    pub min_zncc: f32,
}

/// Views as the tracker sees them.
pub(crate) struct Views<'a> {
    /// Gray pictures with masks.
    pub pyramids: &'a [Pyramid],
    /// Present guess of `world_from_camera`.
    pub poses: &'a [Isometry3<f64>],
    /// Of level 0.
    pub camera: Intrinsics,
}

impl Views<'_> {
    /// The ray (z = 1) through a pixel.
    pub fn ray(&self, pixel: &Vector2<f64>) -> Vector3<f64> {
        let k = &self.camera;
        Vector3::new((pixel.x - k.cx) / k.fx, (pixel.y - k.cy) / k.fy, 1.0)
    }

    /// Where a world point is seen; `None` behind the camera.
    pub fn project(&self, view: usize, point: &Vector3<f64>) -> Option<Vector2<f64>> {
        let p = self.poses[view].inverse_transform_point(&(*point).into());
        let k = &self.camera;
        (p.z > 1e-6).then(|| Vector2::new(k.fx * p.x / p.z + k.cx, k.fy * p.y / p.z + k.cy))
    }

    /// The world point on a pixel's ray at a depth.
    pub fn lifted(&self, view: usize, pixel: &Vector2<f64>, depth: f64) -> Vector3<f64> {
        self.poses[view].transform_point(&(self.ray(pixel) * depth).into()).coords
    }
}

/// A depth at which pictures some views apart look alike.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct CommonDepth {
    /// mm.
    pub depth: f64,
    /// Mean cube of the corners' correlation at it, 0–1.
    pub agreement: f64,
}

/// Views are compared so many apart, the farthest first: depth shows more the farther, but a fast scope has left the place by then.
const GAPS: [usize; 5] = [6, 4, 3, 2, 1];
/// A wider gap is preferred to a narrower one that agrees a little better.
const PREFERENCE: f64 = 0.8;

/// The depth at which corners agree best; `None` if the camera does not move or nothing fits.
pub(crate) fn common_depth(views: &Views<'_>, choice: &TrackingChoice) -> Option<CommonDepth> {
    let n = views.poses.len();
    let mut best: Option<CommonDepth> = None;
    for gap in GAPS.into_iter().filter(|gap| *gap <= (n / 10).max(1)) {
        let found = depth_across(views, gap, choice);
        if let Some(found) = found
            && best.is_none_or(|best| PREFERENCE * found.agreement > best.agreement)
        {
            best = Some(found);
        }
    }
    best
}

fn depth_across(views: &Views<'_>, gap: usize, choice: &TrackingChoice) -> Option<CommonDepth> {
    let n = views.poses.len();
    let pairs: Vec<(usize, usize)> = (0..n.saturating_sub(gap))
        .step_by((n / 10).max(1))
        .map(|i| (i, i + gap))
        .collect();
    let mut baselines: Vec<f64> = pairs.iter().map(|(a, b)| baseline(views, *a, *b)).collect();
    baselines.sort_by(f64::total_cmp);
    let typical = *baselines.get(baselines.len() / 2)?;
    if typical.is_nan() || typical <= 0.0 {
        return None;
    }
    let depths: Vec<f64> = (0..DEPTH_STEPS).map(|k| typical * 2.0 * 1.14f64.powi(k as i32)).collect();
    let votes: Vec<(usize, Vec<f64>)> = pairs
        .par_iter()
        .map(|(a, b)| {
            let level = views.pyramids[*a].levels.len().saturating_sub(2);
            let scale = f64::from(1u32 << level);
            let (image, valid) = (&views.pyramids[*a].levels[level], &views.pyramids[*a].valid[level]);
            let found = corners(
                image,
                valid,
                &CornerChoice {
                    margin: 4,
                    per_cell: 1,
                    ..choice.corners
                },
            );
            let (target, target_valid) = (&views.pyramids[*b].levels[level], &views.pyramids[*b].valid[level]);
            let mut votes = vec![0.0; DEPTH_STEPS];
            for corner in &found {
                let Some(template) = Template::new(image, valid, corner.x, corner.y) else {
                    continue;
                };
                let pixel = Vector2::new(f64::from(corner.x), f64::from(corner.y)) * scale;
                for (vote, depth) in votes.iter_mut().zip(&depths) {
                    let Some(at) = views.project(*b, &views.lifted(*a, &pixel, *depth)) else {
                        continue;
                    };
                    let at = at / scale;
                    let zncc = template.zncc_at(target, target_valid, NO_WARP, (at.x as f32, at.y as f32));
                    *vote += f64::from(zncc.unwrap_or(0.0).max(0.0)).powi(3);
                }
            }
            (found.len(), votes)
        })
        .collect();
    let corners: usize = votes.iter().map(|(corners, _)| corners).sum();
    let sums: Vec<f64> = (0..DEPTH_STEPS)
        .map(|k| votes.iter().map(|(_, votes)| votes[k]).sum())
        .collect();
    // A little smoothing: neighbouring depths support each other.
    let smooth = |k: usize| sums[k] + 0.5 * (sums[k.saturating_sub(1)] + sums[(k + 1).min(DEPTH_STEPS - 1)]);
    let best = (0..DEPTH_STEPS).max_by(|a, b| smooth(*a).total_cmp(&smooth(*b)))?;
    (sums[best] > 0.0).then(|| CommonDepth {
        depth: depths[best],
        agreement: sums[best] / corners.max(1) as f64,
    })
}

fn baseline(views: &Views<'_>, a: usize, b: usize) -> f64 {
    (views.poses[a].translation.vector - views.poses[b].translation.vector).norm()
}

/// Follow the corners of every anchor.
pub(crate) fn tracks(views: &Views<'_>, depth: f64, choice: &TrackingChoice, done: &(dyn Fn() + Sync)) -> Vec<Track> {
    let n = views.poses.len();
    let half = choice.anchor_step / 2;
    let anchors: Vec<usize> = (0..n)
        .filter(|i| i % choice.anchor_step.max(1) == half.min(n.saturating_sub(1)))
        .collect();
    let per_anchor: Vec<Vec<Track>> = anchors
        .par_iter()
        .map(|anchor| {
            let found = anchored(views, *anchor, depth, choice);
            done();
            found
        })
        .collect();
    per_anchor.into_iter().flatten().collect()
}

/// A corner on its way.
struct Follower {
    templates: Vec<Option<Template>>,
    at: Vector2<f64>,
    depth: f64,
}

fn anchored(views: &Views<'_>, anchor: usize, depth: f64, choice: &TrackingChoice) -> Vec<Track> {
    let pyramid = &views.pyramids[anchor];
    let found = corners(&pyramid.levels[0], &pyramid.valid[0], &choice.corners);
    let mut tracks: Vec<Track> = found
        .iter()
        .map(|c| Track {
            anchor,
            observations: vec![(anchor, Vector2::new(f64::from(c.x), f64::from(c.y)))],
        })
        .collect();
    for direction in [1isize, -1] {
        let mut followers: Vec<Option<Follower>> = tracks
            .iter()
            .map(|track| {
                let at = track.observations[0].1;
                let templates = pyramid
                    .levels
                    .iter()
                    .zip(&pyramid.valid)
                    .enumerate()
                    .map(|(level, (image, valid))| {
                        let scale = f64::from(1u32 << level);
                        Template::new(image, valid, (at.x / scale) as f32, (at.y / scale) as f32)
                    })
                    .collect();
                Some(Follower { templates, at, depth })
            })
            .collect();
        let mut from = anchor;
        for step in 1..=choice.reach_views as isize {
            let Some(to) = anchor.checked_add_signed(direction * step).filter(|v| *v < views.poses.len()) else {
                break;
            };
            let moved: Vec<Option<Vector2<f64>>> = tracks
                .iter()
                .zip(&followers)
                .map(|(track, follower)| {
                    let follower = follower.as_ref()?;
                    let world = views.lifted(anchor, &track.observations[0].1, follower.depth);
                    Some(follower.at + views.project(to, &world)? - views.project(from, &world)?)
                })
                .collect();
            // All corners err alike when a pose does: what the coarsest level says on the median goes to all.
            let common = common_shift(views, to, &followers, &moved);
            for ((track, slot), predicted) in tracks.iter_mut().zip(followers.iter_mut()).zip(&moved) {
                let found = slot
                    .as_ref()
                    .zip(*predicted)
                    .and_then(|(f, p)| refined(views, to, f, p + common, choice.min_zncc));
                match (found, slot.as_mut()) {
                    (Some(at), Some(follower)) => {
                        follower.at = at;
                        track.observations.push((to, at));
                    }
                    _ => *slot = None,
                }
            }
            if followers.iter().all(Option::is_none) {
                break;
            }
            from = to;
        }
    }
    tracks.retain(|t| t.observations.len() >= 3);
    tracks
}

fn common_shift(views: &Views<'_>, to: usize, followers: &[Option<Follower>], moved: &[Option<Vector2<f64>>]) -> Vector2<f64> {
    let pyramid = &views.pyramids[to];
    let level = pyramid.levels.len() - 1;
    let scale = f64::from(1u32 << level);
    let mut shifts: Vec<Vector2<f64>> = Vec::new();
    for (follower, predicted) in followers.iter().zip(moved) {
        let Some((follower, predicted)) = follower.as_ref().zip(*predicted) else {
            continue;
        };
        let Some(template) = follower.templates.get(level).and_then(Option::as_ref) else {
            continue;
        };
        let start = ((predicted.x / scale) as f32, (predicted.y / scale) as f32);
        let found = template.locate(&pyramid.levels[level], &pyramid.valid[level], NO_WARP, start, REACH_PX, 6);
        if let Some(m) = found.filter(|m| m.zncc > 0.7) {
            shifts.push(Vector2::new(f64::from(m.x - start.0), f64::from(m.y - start.1)) * scale);
        }
    }
    if shifts.len() < 5 {
        return Vector2::zeros();
    }
    let median = |of: fn(&Vector2<f64>) -> f64| {
        let mut values: Vec<f64> = shifts.iter().map(of).collect();
        values.sort_by(f64::total_cmp);
        values[values.len() / 2]
    };
    Vector2::new(median(|s| s.x), median(|s| s.y))
}

/// From coarse to fine; a coarse level that fails is passed over, the finest must succeed.
fn refined(views: &Views<'_>, to: usize, follower: &Follower, predicted: Vector2<f64>, min_zncc: f32) -> Option<Vector2<f64>> {
    let pyramid = &views.pyramids[to];
    let mut at = predicted;
    for level in (0..pyramid.levels.len()).rev() {
        let scale = f64::from(1u32 << level);
        let template = follower.templates.get(level).and_then(Option::as_ref);
        let start = ((at.x / scale) as f32, (at.y / scale) as f32);
        let steps = if level == 0 { 12 } else { 5 };
        let found =
            template.and_then(|t| t.locate(&pyramid.levels[level], &pyramid.valid[level], NO_WARP, start, REACH_PX, steps));
        match found {
            Some(m) if level == 0 => {
                return (m.zncc >= min_zncc).then(|| Vector2::new(f64::from(m.x), f64::from(m.y)));
            }
            Some(m) if m.zncc > 0.6 => at = Vector2::new(f64::from(m.x), f64::from(m.y)) * scale,
            _ => {}
        }
    }
    None
}
