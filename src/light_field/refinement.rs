//! The chain that refines a survey, step by step; what it is about stands in `survey`.

use rayon::prelude::*;

use nalgebra::{Isometry3, Matrix6, Vector6};

use crate::camera::intrinsics::{Intrinsics, Pixel};
use crate::camera::model::CameraModel;
use crate::geometry::point::Point;
use crate::geometry::space::{Camera, World};
use crate::geometry::transform::Transform;
use crate::image::corners::CornerChoice;
use crate::image::gradient::gray_from_rgb;
use crate::image::pyramid::{Pyramid, eroded, halved, halved_mask, smoothed};
use crate::light_field::prior::{PosePrior, smoothed_pose};
use crate::light_field::reobservation::{Feature, ReobservationChoice, reobserved};
use crate::light_field::survey::{RefinedSurvey, ScenePoint, Settings, SurveyError, SurveyFrame};
use crate::light_field::survey_report::{Corrections, SurveyReport};
use crate::light_field::time_offset::{self, TimeOffset};
use crate::light_field::tracking::{TrackingChoice, Views, common_depth, tracks};
use crate::light_field::triangulation::triangulated;
use crate::progress::Progress;
use crate::solver::bundle_adjustment::{self, Observation, Pinhole, Problem};
use crate::solver::robust_loss::RobustLoss;
use crate::time::{Span, Timestamp};

/// Fewest scene points of a survey.
const MIN_POINTS: usize = 20;
/// Pyramid levels beneath the working picture.
const LEVELS: usize = 4;
/// Residuals above this many robust standard deviations leave the adjustment.
const OUTLIER_SIGMAS: f64 = 4.0;
/// Mean cube of correlations at one depth from which on the poses need no other clock.
const PLAIN_AGREEMENT: f64 = 0.3;
/// Clocks are tried in such steps, ms: the picture of a fast scope moves a corner's width meanwhile.
const OFFSET_STEP_MS: f64 = 20.0;
/// The priors stay this loose along the path, ms.
const MIN_OFFSET_DOUBT_MS: f64 = 3.0;
/// A reprojection error above this tells that the tissue moved, px.
const RIGID_RMS_PX: f64 = 0.6;

/// Pictures, present poses and present offset of a survey on its way from rough to refined.
pub(crate) struct Refinement<'a> {
    frames: &'a [SurveyFrame],
    prior: &'a dyn PosePrior,
    settings: &'a Settings,
    pyramids: Vec<Pyramid>,
    camera: Intrinsics,
    /// Given px per working px.
    scale: f64,
    poses: Vec<Isometry3<f64>>,
    offset: TimeOffset,
    offset_found: bool,
    without_prior: Vec<u32>,
    notes: Vec<String>,
}

impl<'a> Refinement<'a> {
    /// Checks the survey and starts from the arm's poses.
    pub(crate) fn new(
        frames: &'a [SurveyFrame],
        camera: &CameraModel,
        prior: &'a dyn PosePrior,
        settings: &'a Settings,
    ) -> Result<Self, SurveyError> {
        if frames.len() < 3 {
            return Err(SurveyError::TooFewViews(frames.len()));
        }
        for f in frames {
            if f.image.size() != (camera.width, camera.height) || f.confidence.size() != f.image.size() {
                return Err(SurveyError::Size {
                    frame: f.frame_number,
                    found_width: f.image.width(),
                    found_height: f.image.height(),
                    width: camera.width,
                    height: camera.height,
                });
            }
        }
        let mut halvings = 0;
        while camera.width >> halvings > settings.max_working_width_px.max(64) {
            halvings += 1;
        }
        let scale = f64::from(1u32 << halvings);
        let k = &camera.intrinsics;
        let offset = TimeOffset {
            offset: Span::from_milliseconds(settings.known_time_offset_ms.unwrap_or(0.0)),
            sigma_ms: settings.time_offset_doubt_ms,
        };
        let (poses, without_prior) = initial_poses(frames, prior, settings, offset.offset)?;
        Ok(Self {
            frames,
            prior,
            settings,
            pyramids: frames.par_iter().map(|f| working_pyramid(f, halvings)).collect(),
            camera: Intrinsics {
                fx: k.fx / scale,
                fy: k.fy / scale,
                cx: k.cx / scale,
                cy: k.cy / scale,
            },
            scale,
            poses,
            offset,
            offset_found: false,
            without_prior,
            notes: Vec::new(),
        })
    }

    /// The chain of `survey`'s description.
    pub(crate) fn run(mut self, progress: &dyn Progress) -> Result<RefinedSurvey, SurveyError> {
        let anchor_step = self.frames.len().div_ceil(self.settings.anchors.max(1)).max(1);
        let choice = TrackingChoice {
            corners: CornerChoice {
                cells: self.settings.corner_cells,
                per_cell: 1,
                min_strength: self.settings.min_corner_strength,
                margin: 12,
            },
            anchor_step,
            reach_views: self.settings.reach_views.max(anchor_step),
            min_zncc: self.settings.min_zncc,
        };
        progress.begin("tracking", (self.frames.len() / anchor_step) as u64);
        let mut features = {
            let depth = self.first_look(&choice)?;
            let views = self.views();
            let tracks = tracks(&views, depth, &choice, &|| progress.advance(1));
            let keep_every = (tracks.len() as f64 / self.settings.max_points.max(MIN_POINTS) as f64).max(1.0);
            let mut next = 0.0;
            let mut features = Vec::new();
            for (i, track) in tracks.into_iter().enumerate() {
                if i as f64 >= next {
                    next += keep_every;
                    let position = triangulated(&views, &track.observations)
                        .filter(|p| plausible(&views, &track.observations, p, depth))
                        .unwrap_or_else(|| views.lifted(track.anchor, &track.observations[0].1, depth));
                    features.push(Feature { track, position });
                }
            }
            features
        };
        progress.end();
        self.check(&features, progress)?;
        let passes = 4;
        progress.begin("adjusting", passes);
        // Loose at first: wrong tracks, rough points.
        let mut sigma_px = 1.0;
        self.adjust(&mut features, &mut sigma_px, 15);
        self.find_offset(&features);
        self.adjust(&mut features, &mut sigma_px, 8);
        progress.advance(1);
        for (reach_px, iterations) in [(6.0, 10), (2.5, 8), (1.5, 12)] {
            self.check(&features, progress)?;
            let reobservation = ReobservationChoice {
                min_zncc: self.settings.min_zncc,
                reach_px,
                margin_px: 8.0,
            };
            features = reobserved(&self.views(), &features, &reobservation, &|| ());
            self.check(&features, progress)?;
            sigma_px = 0.4;
            self.adjust(&mut features, &mut sigma_px, iterations);
            self.find_offset(&features);
            progress.advance(1);
        }
        self.adjust(&mut features, &mut sigma_px, 10);
        progress.end();
        self.check(&features, progress)?;
        Ok(self.result(&features))
    }

    /// The depth at which the pictures agree; where they hardly do at the offset known so far, with the clocks so far apart that they do.
    fn first_look(&mut self, choice: &TrackingChoice) -> Result<f64, SurveyError> {
        let mut best = common_depth(&self.views(), choice);
        let known = self.offset.offset;
        let range = self.settings.time_offset_range_ms;
        let tried = (1..)
            .map(|step| f64::from(step) * OFFSET_STEP_MS)
            .take_while(|ms| *ms <= range)
            .flat_map(|ms| [-ms, ms]);
        for ms in tried {
            if best.is_some_and(|best| best.agreement >= PLAIN_AGREEMENT) {
                break;
            }
            let offset = Span(known.0 + Span::from_milliseconds(ms).0);
            let (poses, _) = initial_poses(self.frames, self.prior, self.settings, offset)?;
            let views = Views {
                poses: &poses,
                ..self.views()
            };
            let found = common_depth(&views, choice);
            if found.map_or(0.0, |found| found.agreement) > best.map_or(0.0, |best| best.agreement) {
                best = found;
                self.poses = poses;
                self.offset.offset = offset;
            }
        }
        tracing::debug!(?best, offset_ms = self.offset.offset.milliseconds(), "first look");
        best.map(|best| best.depth).ok_or(SurveyError::NoParallax)
    }

    fn views(&self) -> Views<'_> {
        Views {
            pyramids: &self.pyramids,
            poses: &self.poses,
            camera: self.camera,
        }
    }

    fn check(&self, features: &[Feature], progress: &dyn Progress) -> Result<(), SurveyError> {
        if progress.stopping() {
            return Err(SurveyError::Stopped);
        }
        if features.len() < MIN_POINTS {
            return Err(SurveyError::TooFewPoints {
                found: features.len(),
                needed: MIN_POINTS,
            });
        }
        Ok(())
    }

    /// Adjust poses and points, drop outliers, and learn the observations' noise.
    fn adjust(&mut self, features: &mut Vec<Feature>, sigma_px: &mut f64, iterations: usize) {
        let mut problem = self.problem(features, *sigma_px);
        problem.adjust(iterations);
        let mut errors: Vec<f64> = problem
            .observations
            .iter()
            .enumerate()
            .flat_map(|(i, seen)| seen.iter().filter_map(|o| problem.error_px(i, o)).collect::<Vec<_>>())
            .collect();
        errors.sort_by(f64::total_cmp);
        // The median of a Rayleigh variable is 1.18 σ.
        let typical = errors.get(errors.len() / 2).copied().unwrap_or(1.0) / 1.18;
        *sigma_px = typical.clamp(0.1, 4.0);
        let limit = (OUTLIER_SIGMAS * *sigma_px).max(0.8);
        for (i, (feature, seen)) in features.iter_mut().zip(&mut problem.observations).enumerate() {
            let mut good = seen.iter().map(|o| {
                let p = problem.poses[o.view]
                    .inverse_transform_point(&problem.points[i].into())
                    .coords;
                problem.camera.project(&p).is_some_and(|q| (q - o.pixel).norm() < limit)
            });
            // The anchor stays first; a point whose anchor does not fit is gone as a whole.
            if good.next() != Some(true) {
                feature.track.observations.clear();
                continue;
            }
            let mut keep = std::iter::once(true).chain(good);
            feature.track.observations.retain(|_| keep.next().unwrap_or(false));
            feature.position = problem.points[i];
        }
        features.retain(|f| f.track.observations.len() >= 3);
        self.poses = problem.poses;
        self.mind_moving_tissue(features, sigma_px);
    }

    /// Breathing moves all points of a view alike, so the errors of its observations do not average out: where the pictures
    /// contradict both a rigid scene and the arm, they lose weight until the arm's poses are as far off as the arm may be.
    fn mind_moving_tissue(&mut self, features: &[Feature], sigma_px: &mut f64) {
        let rms = *sigma_px;
        if rms * std::f64::consts::SQRT_2 < RIGID_RMS_PX || !self.offset_found {
            return;
        }
        for _ in 0..4 {
            let mut problem = self.problem(features, *sigma_px);
            let deviations: Vec<f64> = problem
                .priors
                .iter()
                .zip(&problem.poses)
                .filter_map(|(prior, pose)| {
                    let prior = prior.as_ref()?;
                    let r = prior.residual(pose);
                    Some(r.dot(&(prior.information * r)) / 6.0)
                })
                .collect();
            let excess = deviations.iter().sum::<f64>() / deviations.len().max(1) as f64;
            if excess < 1.5 || *sigma_px > 20.0 * rms {
                return;
            }
            *sigma_px *= excess.sqrt().min(3.0);
            problem.sigma_px = *sigma_px;
            problem.adjust(8);
            self.poses = problem.poses;
        }
    }

    fn problem(&self, features: &[Feature], sigma_px: f64) -> Problem {
        let k = &self.camera;
        Problem {
            camera: Pinhole {
                fx: k.fx,
                fy: k.fy,
                cx: k.cx,
                cy: k.cy,
            },
            poses: self.poses.clone(),
            priors: self.frames.iter().map(|f| self.prior_of(f)).collect(),
            points: features.iter().map(|f| f.position).collect(),
            observations: features
                .iter()
                .map(|f| {
                    f.track
                        .observations
                        .iter()
                        .map(|(view, pixel)| Observation {
                            view: *view,
                            pixel: *pixel,
                        })
                        .collect()
                })
                .collect(),
            sigma_px,
            loss: RobustLoss::Cauchy { width: 2.5 },
            prior_loss: RobustLoss::Huber { width: 6.0 },
        }
    }

    /// The arm's pose at a frame's exposure, loose along the path by the doubt about the clocks.
    fn prior_of(&self, frame: &SurveyFrame) -> Option<bundle_adjustment::PosePrior> {
        let at = frame.exposed_at - self.offset.offset;
        let smoothing = self.settings.prior_smoothing_ms;
        let pose = smoothed_pose(self.prior, at, smoothing)?;
        let half = Span::from_milliseconds(20.0);
        let speed = match (
            smoothed_pose(self.prior, at - half, smoothing),
            smoothed_pose(self.prior, at + half, smoothing),
        ) {
            (Some(before), Some(after)) => {
                let inverse = pose.rotation().inverse();
                let t = inverse * (after.translation() - before.translation());
                let r = (before.rotation().inverse() * after.rotation()).scaled_axis();
                Vector6::new(t.x, t.y, t.z, r.x, r.y, r.z) / (2.0 * half.milliseconds())
            }
            _ => Vector6::zeros(),
        };
        let (mm, rad) = (self.prior.sigma_mm().max(1e-6), self.prior.sigma_rad().max(1e-8));
        let noise = Matrix6::from_diagonal(&Vector6::new(mm * mm, mm * mm, mm * mm, rad * rad, rad * rad, rad * rad));
        // Early estimates lean on priors taken at the wrong instant: never quite sure.
        let along = speed * self.offset.sigma_ms.max(MIN_OFFSET_DOUBT_MS);
        let information = (noise + along * along.transpose()).try_inverse()?;
        Some(bundle_adjustment::PosePrior {
            mean: *pose.isometry(),
            information,
        })
    }

    fn find_offset(&mut self, features: &[Feature]) {
        if self.settings.time_offset_range_ms <= 0.0 {
            return;
        }
        let tied = self.observations_per_view(features);
        let poses: Vec<(Timestamp, Transform<World, Camera>)> = self
            .frames
            .iter()
            .zip(&self.poses)
            .zip(&tied)
            .filter(|(_, tied)| **tied >= self.settings.min_view_observations)
            .map(|((f, pose), _)| (f.exposed_at, Transform::from_isometry(*pose)))
            .collect();
        let start = Span::from_milliseconds(self.settings.known_time_offset_ms.unwrap_or(0.0));
        let shifted: Vec<_> = poses.iter().map(|(at, pose)| (*at - start, *pose)).collect();
        let found = time_offset::estimate(
            &shifted,
            self.prior,
            self.settings.prior_smoothing_ms,
            self.settings.time_offset_range_ms,
        )
        .filter(|found| found.sigma_ms < 0.4 * self.settings.time_offset_doubt_ms);
        tracing::debug!(?found, "time offset");
        if let Some(found) = found {
            self.offset = TimeOffset {
                offset: Span(found.offset.0 + start.0),
                sigma_ms: found.sigma_ms,
            };
            self.offset_found = true;
        }
    }

    fn observations_per_view(&self, features: &[Feature]) -> Vec<usize> {
        let mut counts = vec![0; self.frames.len()];
        for (view, _) in features.iter().flat_map(|f| &f.track.observations) {
            counts[*view] += 1;
        }
        counts
    }

    fn result(mut self, features: &[Feature]) -> RefinedSurvey {
        let counts = self.observations_per_view(features);
        let tied: Vec<bool> = counts.iter().map(|n| *n >= self.settings.min_view_observations).collect();
        let dropped: Vec<u32> = self
            .frames
            .iter()
            .zip(&tied)
            .filter(|(_, tied)| !**tied)
            .map(|(f, _)| f.frame_number)
            .collect();
        if !dropped.is_empty() {
            self.notes.push(format!(
                "{} of {} views could not be tied to the others and were left out",
                dropped.len(),
                tied.len()
            ));
        }
        if !self.offset_found {
            self.notes
                .push("the motion does not tell the time offset between arm and camera; taken as known or zero".to_owned());
        }
        if !self.without_prior.is_empty() {
            self.notes.push(format!(
                "{} views have no arm pose and were placed by the pictures alone",
                self.without_prior.len()
            ));
        }
        let refined = self.problem(features, 1.0);
        let mut before = refined.clone();
        if let Ok((poses, _)) = initial_poses(
            self.frames,
            self.prior,
            &Settings {
                prior_smoothing_ms: 0.0,
                ..self.settings.clone()
            },
            Span(0),
        ) {
            before.poses = poses;
            let views = Views {
                pyramids: &self.pyramids,
                poses: &before.poses,
                camera: self.camera,
            };
            for (point, f) in before.points.iter_mut().zip(features) {
                *point = triangulated(&views, &f.track.observations).unwrap_or(*point);
            }
        }
        let refined_px = refined.rms_px() * self.scale;
        if refined_px > RIGID_RMS_PX * 2.0 * self.scale {
            self.notes.push(format!(
                "the tissue moved during the survey: {refined_px:.1} px remain after refinement"
            ));
        }
        let mut depths: Vec<f64> = features
            .iter()
            .map(|f| self.poses[f.track.anchor].inverse_transform_point(&f.position.into()).z)
            .collect();
        depths.sort_by(f64::total_cmp);
        let report = SurveyReport {
            views: self.frames.len(),
            refined_views: tied.iter().filter(|t| **t).count(),
            dropped_frames: dropped,
            frames_without_prior: self.without_prior.clone(),
            points: features.len(),
            observations: counts.iter().sum(),
            prior_reprojection_px: before.rms_px() * self.scale,
            refined_reprojection_px: refined_px,
            corrections: self.corrections(&tied),
            time_offset_ms: self.offset.offset.milliseconds(),
            time_offset_sigma_ms: self.offset_found.then_some(self.offset.sigma_ms),
            median_depth_mm: depths.get(depths.len() / 2).copied().unwrap_or(0.0),
            notes: self.notes.clone(),
        };
        let pixel = |p: &nalgebra::Vector2<f64>| Pixel {
            x: p.x * self.scale,
            y: p.y * self.scale,
        };
        RefinedSurvey {
            world_from_camera: self
                .poses
                .iter()
                .zip(&tied)
                .map(|(p, tied)| tied.then(|| Transform::from_isometry(*p)))
                .collect(),
            points: features
                .iter()
                .map(|f| ScenePoint {
                    position: Point::from_coords(f.position),
                    observations: f
                        .track
                        .observations
                        .iter()
                        .filter(|(view, _)| tied[*view])
                        .map(|(view, p)| (*view as u32, pixel(p)))
                        .collect(),
                })
                .collect(),
            time_offset: self.offset.offset,
            report,
        }
    }

    fn corrections(&self, tied: &[bool]) -> Corrections {
        let (mut mm, mut deg) = (Vec::new(), Vec::new());
        for ((frame, pose), _) in self.frames.iter().zip(&self.poses).zip(tied).filter(|(_, tied)| **tied) {
            if let Some(prior) = self.prior.world_from_camera(frame.exposed_at - self.offset.offset) {
                mm.push((prior.translation() - pose.translation.vector).norm());
                deg.push(prior.rotation().angle_to(&pose.rotation).to_degrees());
            }
        }
        let rms = |v: &[f64]| (v.iter().map(|x| x * x).sum::<f64>() / v.len().max(1) as f64).sqrt();
        let max = |v: &[f64]| v.iter().copied().fold(0.0, f64::max);
        Corrections {
            rms_mm: rms(&mm),
            max_mm: max(&mm),
            rms_deg: rms(&deg),
            max_deg: max(&deg),
        }
    }
}

/// The arm's poses at the exposures, gaps filled between neighbours; and the frames that had none.
fn initial_poses(
    frames: &[SurveyFrame],
    prior: &dyn PosePrior,
    settings: &Settings,
    offset: Span,
) -> Result<(Vec<Isometry3<f64>>, Vec<u32>), SurveyError> {
    let known: Vec<Option<Transform<World, Camera>>> = frames
        .iter()
        .map(|f| smoothed_pose(prior, f.exposed_at - offset, settings.prior_smoothing_ms))
        .collect();
    let found = known.iter().flatten().count();
    if found < 2 {
        return Err(SurveyError::TooFewPoses {
            found,
            views: frames.len(),
        });
    }
    let missing = frames
        .iter()
        .zip(&known)
        .filter(|(_, k)| k.is_none())
        .map(|(f, _)| f.frame_number)
        .collect();
    let poses = (0..frames.len())
        .filter_map(|i| {
            let before = (0..=i).rev().find_map(|j| known[j].map(|p| (j, p)));
            let after = (i..frames.len()).find_map(|j| known[j].map(|p| (j, p)));
            Some(match (before, after) {
                (Some((a, from)), Some((b, to))) if a < b => {
                    let whole = (frames[b].exposed_at - frames[a].exposed_at).seconds();
                    let part = (frames[i].exposed_at - frames[a].exposed_at).seconds();
                    *from
                        .interpolated(&to, if whole > 0.0 { part / whole } else { 0.5 })
                        .isometry()
                }
                (Some((_, pose)), _) | (_, Some((_, pose))) => *pose.isometry(),
                (None, None) => return None,
            })
        })
        .collect();
    Ok((poses, missing))
}

fn working_pyramid(frame: &SurveyFrame, halvings: usize) -> Pyramid {
    let mut gray = gray_from_rgb(&frame.image);
    let mut valid = frame.confidence.clone();
    for _ in 0..halvings {
        gray = halved(&gray);
        valid = halved_mask(&valid);
    }
    // A little smoothing takes noise and the interpolation's own error out of the patches.
    // It carries what is masked two px farther, and interpolation one more.
    Pyramid::new(smoothed(&gray), eroded(&valid, 3), LEVELS)
}

/// In front of all its views, and not absurdly near or far.
fn plausible(
    views: &Views<'_>,
    observations: &[(usize, nalgebra::Vector2<f64>)],
    point: &nalgebra::Vector3<f64>,
    depth: f64,
) -> bool {
    observations.iter().all(|(view, _)| {
        let z = views.poses[*view].inverse_transform_point(&(*point).into()).z;
        z > 0.3 * depth && z < 3.0 * depth
    })
}
