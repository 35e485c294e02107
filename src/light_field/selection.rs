//! Which frames of a survey become views: evenly spaced along the path, the sharpest of their neighbourhood.
//!
//! Spacing is measured as the image motion a step causes: with the depth d of the scene, a sideways step b and a turn α move the
//! picture by about b/d + α radians. Where the camera rests, no view is added; a blurred frame gives way to a sharper neighbour.

use crate::geometry::space::{Camera, World};
use crate::geometry::transform::Transform;
use crate::image::buffer::{Image, Rgb8};
use crate::time::Timestamp;

/// What is known of a frame without much work.
#[derive(Clone, Copy, Debug)]
pub struct ViewCandidate {
    /// The frame's number in the recording.
    pub frame_number: u32,
    /// When it was exposed.
    pub exposed_at: Timestamp,
    /// From [`sharpness`]; only compared with that of its neighbours.
    pub sharpness: f64,
    /// Where the arm says the camera was.
    pub world_from_camera: Option<Transform<World, Camera>>,
}

/// How views are chosen.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SelectionSettings {
    /// Views wanted; fewer where the path is short.
    pub target_views: usize,
    /// Steps that move the picture by less are not worth a view, rad (1 px of 960 is about 0.001).
    pub min_step_rad: f64,
    /// Typical distance of the scene, mm; weighs sideways steps against turns.
    pub scene_depth_mm: f64,
    /// A frame less sharp than this share of its neighbours' median is skipped.
    pub min_relative_sharpness: f64,
    /// Poses are averaged over this time before the path is measured, so that noise adds no length, ms.
    pub path_smoothing_ms: f64,
}

impl Default for SelectionSettings {
    fn default() -> Self {
        Self {
            target_views: 96,
            min_step_rad: 0.006,
            scene_depth_mm: 75.0,
            min_relative_sharpness: 0.6,
            path_smoothing_ms: 160.0,
        }
    }
}

/// How sharp a picture is: the mean squared Laplacian of every second row's green.
pub fn sharpness(image: &Image<Rgb8>) -> f64 {
    let (width, height) = image.size();
    if width < 3 || height < 3 {
        return 0.0;
    }
    let (mut sum, mut count) = (0.0f64, 0usize);
    for y in (1..height - 1).step_by(2) {
        let (above, row, below) = (image.row(y - 1), image.row(y), image.row(y + 1));
        for x in 1..width - 1 {
            let around = i32::from(above[x][1]) + i32::from(below[x][1]) + i32::from(row[x - 1][1]) + i32::from(row[x + 1][1]);
            let laplacian = around - 4 * i32::from(row[x][1]);
            // A specularity's rim is sharp in a blurred picture too: bounded.
            sum += f64::from(laplacian.clamp(-24, 24)).powi(2);
            count += 1;
        }
    }
    sum / count.max(1) as f64
}

/// Indices of the frames to become views, in their order. Without poses: evenly in time.
pub fn select_views(candidates: &[ViewCandidate], settings: &SelectionSettings) -> Vec<usize> {
    let target = settings.target_views.max(2);
    let position = path_positions(candidates, settings);
    let length = position.last().copied().unwrap_or(0.0);
    let known = candidates.iter().filter(|c| c.world_from_camera.is_some()).count();
    if known < 2 {
        let step = (candidates.len() as f64 / target as f64).max(1.0);
        let count = (candidates.len() as f64 / step).floor() as usize;
        return (0..count).map(|i| (i as f64 * step) as usize).collect();
    }
    let sharp = relative_sharpness(candidates);
    let step = (length / target as f64).max(settings.min_step_rad);
    let mut chosen = Vec::new();
    let mut best: Option<(usize, usize)> = None;
    let bin_of = |i: usize| (position[i] / step) as usize;
    for i in 0..candidates.len() {
        if sharp[i] < settings.min_relative_sharpness || candidates[i].world_from_camera.is_none() {
            continue;
        }
        match best {
            Some((bin, leader)) if bin == bin_of(i) => {
                if sharp[i] > sharp[leader] {
                    best = Some((bin, i));
                }
            }
            _ => {
                chosen.extend(best.map(|b| b.1));
                best = Some((bin_of(i), i));
            }
        }
    }
    chosen.extend(best.map(|b| b.1));
    chosen
}

/// How far the camera has come at each candidate, in radians of image motion.
fn path_positions(candidates: &[ViewCandidate], settings: &SelectionSettings) -> Vec<f64> {
    let half = settings.path_smoothing_ms * 0.5e6;
    let smooth: Vec<Option<Transform<World, Camera>>> = candidates
        .iter()
        .map(|c| {
            let centre = c.world_from_camera?;
            let near = candidates
                .iter()
                .filter(|n| ((n.exposed_at - c.exposed_at).0 as f64).abs() <= half);
            let (mut t, mut r, mut n) = (nalgebra::Vector3::zeros(), nalgebra::Vector3::zeros(), 0.0);
            for pose in near.filter_map(|n| n.world_from_camera) {
                t += pose.translation();
                r += (centre.rotation().inverse() * pose.rotation()).scaled_axis();
                n += 1.0;
            }
            Some(Transform::new(
                centre.rotation() * nalgebra::UnitQuaternion::from_scaled_axis(r / n),
                t / n,
            ))
        })
        .collect();
    let mut length = 0.0;
    let mut last: Option<Transform<World, Camera>> = None;
    smooth
        .iter()
        .map(|pose| {
            if let (Some(pose), Some(from)) = (pose, &last) {
                let step = from.inverse() * *pose;
                length += step.translation().norm() / settings.scene_depth_mm + step.rotation().angle();
            }
            last = pose.or(last);
            length
        })
        .collect()
}

/// Sharpness as a share of the median over ±8 neighbours.
fn relative_sharpness(candidates: &[ViewCandidate]) -> Vec<f64> {
    (0..candidates.len())
        .map(|i| {
            let near = &candidates[i.saturating_sub(8)..(i + 9).min(candidates.len())];
            let mut values: Vec<f64> = near.iter().map(|c| c.sharpness).collect();
            values.sort_by(f64::total_cmp);
            candidates[i].sharpness / values[values.len() / 2].max(1e-9)
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use nalgebra::{UnitQuaternion, Vector3};

    use super::*;

    fn candidate(i: usize, x: f64, sharpness: f64) -> ViewCandidate {
        ViewCandidate {
            frame_number: i as u32,
            exposed_at: Timestamp::from_seconds(0.04 * i as f64),
            sharpness,
            world_from_camera: Some(Transform::new(UnitQuaternion::identity(), Vector3::new(x, 0.0, 0.0))),
        }
    }

    #[test]
    fn resting_adds_no_view_and_blur_is_skipped() {
        let mut frames: Vec<_> = (0..100).map(|i| candidate(i, i as f64, 50.0)).collect();
        frames.extend((100..200).map(|i| candidate(i, 99.0, 50.0)));
        frames[40].sharpness = 10.0;
        frames[41].sharpness = 10.0;
        let chosen = select_views(
            &frames,
            &SelectionSettings {
                target_views: 50,
                ..Default::default()
            },
        );
        assert!((45..=55).contains(&chosen.len()), "{}", chosen.len());
        assert!(chosen.iter().filter(|i| **i > 105).count() <= 1);
        assert!(!chosen.contains(&40) && !chosen.contains(&41));
    }

    #[test]
    fn blur_lowers_sharpness() {
        let mut sharp = Image::filled(32, 32, [90u8; 3]);
        let mut soft = sharp.clone();
        for y in 0..32 {
            for x in 0..32 {
                sharp.set(x, y, [if x % 4 < 2 { 80 } else { 100 }; 3]);
                soft.set(x, y, [if x % 8 < 4 { 88 } else { 92 }; 3]);
            }
        }
        assert!(sharpness(&sharp) > 5.0 * sharpness(&soft));
    }
}
