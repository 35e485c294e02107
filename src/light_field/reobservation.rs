//! Known scene points looked for in every view of the survey.
//!
//! Once poses and points are roughly right, each point's place in any view is predicted to a few px, and its anchor's patch can
//! be turned to look as that view would show it: the plane through its neighbours in space maps the patch by a homography, of
//! which the linear part at the point is enough for a patch of 17 px. Tracks that span the whole sweep, all measured against
//! one patch, are what ties far views to each other.

use nalgebra::{Matrix3, Vector2, Vector3};
use rayon::prelude::*;

use crate::image::patch::Template;
use crate::light_field::tracking::{Track, Views};

/// Neighbours that span a point's plane.
const PLANE_NEIGHBOURS: usize = 14;
/// A plane seen flatter than this is not used, cosine of the angle between its normal and the ray.
const MIN_COSINE: f64 = 0.3;

/// A scene point, its track and the direction its surface faces.
#[derive(Clone, Debug)]
pub(crate) struct Feature {
    pub track: Track,
    pub position: Vector3<f64>,
}

/// How points are looked for.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ReobservationChoice {
    /// Least similarity.
    pub min_zncc: f32,
    /// Farthest from the prediction, px.
    pub reach_px: f32,
    /// Border kept free, px.
    pub margin_px: f64,
}

/// Unit normals of the points' planes, each from the nearest other points; `None` where they do not span one.
pub(crate) fn normals(points: &[Vector3<f64>]) -> Vec<Option<Vector3<f64>>> {
    points
        .par_iter()
        .map(|point| {
            let mut by_distance: Vec<(f64, &Vector3<f64>)> = points.iter().map(|p| ((p - point).norm_squared(), p)).collect();
            let count = PLANE_NEIGHBOURS.min(by_distance.len());
            if count < 6 {
                return None;
            }
            by_distance.select_nth_unstable_by(count - 1, |a, b| a.0.total_cmp(&b.0));
            let near = &by_distance[..count];
            let mean = near.iter().map(|n| n.1).sum::<Vector3<f64>>() / count as f64;
            let covariance: Matrix3<f64> = near.iter().map(|n| (n.1 - mean) * (n.1 - mean).transpose()).sum();
            let eigen = covariance.symmetric_eigen();
            let order = {
                let mut order = [0, 1, 2];
                order.sort_by(|a, b| eigen.eigenvalues[*a].total_cmp(&eigen.eigenvalues[*b]));
                order
            };
            // A line of points spans no plane, a ball of points neither.
            let [flat, middle, _] = order.map(|i| eigen.eigenvalues[i].max(0.0));
            (middle > 0.0 && flat < 0.25 * middle).then(|| eigen.eigenvectors.column(order[0]).into_owned())
        })
        .collect()
}

/// The offset in `view` from an offset in the anchor, at a point of a plane.
fn warp(
    views: &Views<'_>,
    anchor: usize,
    view: usize,
    pixel: &Vector2<f64>,
    point: &Vector3<f64>,
    normal: &Vector3<f64>,
) -> Option<[[f32; 2]; 2]> {
    const STEP_PX: f64 = 4.0;
    let origin = views.poses[anchor].translation.vector;
    let height = normal.dot(&(point - origin));
    let on_plane = |offset: Vector2<f64>| {
        let ray = views.poses[anchor].rotation * views.ray(&(pixel + offset));
        let along = normal.dot(&ray);
        let depth = height / along;
        (depth > 0.0 && depth.is_finite())
            .then(|| origin + ray * depth)
            .and_then(|p| views.project(view, &p))
    };
    let x = (on_plane(Vector2::new(STEP_PX, 0.0))? - on_plane(Vector2::new(-STEP_PX, 0.0))?) / (2.0 * STEP_PX);
    let y = (on_plane(Vector2::new(0.0, STEP_PX))? - on_plane(Vector2::new(0.0, -STEP_PX))?) / (2.0 * STEP_PX);
    Some([[x.x as f32, y.x as f32], [x.y as f32, y.y as f32]])
}

/// Look for every feature in every view anew; features seen in fewer than three views are dropped.
pub(crate) fn reobserved(
    views: &Views<'_>,
    features: &[Feature],
    choice: &ReobservationChoice,
    done: &(dyn Fn() + Sync),
) -> Vec<Feature> {
    let positions: Vec<Vector3<f64>> = features.iter().map(|f| f.position).collect();
    let normals = normals(&positions);
    let found: Vec<Option<Feature>> = features
        .par_iter()
        .zip(normals.par_iter())
        .map(|(feature, normal)| {
            let found = reobserved_one(views, feature, normal.as_ref(), choice);
            done();
            found
        })
        .collect();
    found.into_iter().flatten().collect()
}

fn reobserved_one(
    views: &Views<'_>,
    feature: &Feature,
    normal: Option<&Vector3<f64>>,
    choice: &ReobservationChoice,
) -> Option<Feature> {
    let anchor = feature.track.anchor;
    let pixel = feature.track.observations.first()?.1;
    let pyramid = &views.pyramids[anchor];
    let fine = Template::new(&pyramid.levels[0], &pyramid.valid[0], pixel.x as f32, pixel.y as f32)?;
    let coarse = (pyramid.levels.len() > 1)
        .then(|| {
            Template::new(
                &pyramid.levels[1],
                &pyramid.valid[1],
                pixel.x as f32 / 2.0,
                pixel.y as f32 / 2.0,
            )
        })
        .flatten();
    let (width, height) = pyramid.levels[0].size();
    let towards = (feature.position - views.poses[anchor].translation.vector).normalize();
    // Facing the anchor if the neighbours do not tell.
    let normal = normal
        .copied()
        .filter(|n| n.dot(&towards).abs() > MIN_COSINE)
        .unwrap_or(towards);
    let mut observations = vec![(anchor, pixel)];
    for view in (0..views.poses.len()).filter(|v| *v != anchor) {
        let Some(predicted) = views.project(view, &feature.position) else {
            continue;
        };
        let m = choice.margin_px;
        if predicted.x < m || predicted.y < m || predicted.x > width as f64 - 1.0 - m || predicted.y > height as f64 - 1.0 - m {
            continue;
        }
        let ray = (feature.position - views.poses[view].translation.vector).normalize();
        if normal.dot(&ray).abs() < MIN_COSINE {
            continue;
        }
        let Some(warp) = warp(views, anchor, view, &pixel, &feature.position, &normal) else {
            continue;
        };
        let target = &views.pyramids[view];
        let mut start = (predicted.x as f32, predicted.y as f32);
        if choice.reach_px > 3.0
            && let Some(coarse) = &coarse
            && let (Some(image), Some(valid)) = (target.levels.get(1), target.valid.get(1))
            && let Some(m) = coarse.locate(image, valid, warp, (start.0 / 2.0, start.1 / 2.0), choice.reach_px / 2.0, 6)
            && m.zncc > 0.6
        {
            start = (2.0 * m.x, 2.0 * m.y);
        }
        if let Some(m) = fine.locate(&target.levels[0], &target.valid[0], warp, start, choice.reach_px, 10)
            && m.zncc >= choice.min_zncc
        {
            observations.push((view, Vector2::new(f64::from(m.x), f64::from(m.y))));
        }
    }
    (observations.len() >= 3).then_some(Feature {
        track: Track { anchor, observations },
        position: feature.position,
    })
}
