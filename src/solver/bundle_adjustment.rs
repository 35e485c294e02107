//! Bundle adjustment: camera poses and scene points that together explain where the points were seen.
//!
//! Triggs, McLauchlan, Hartley and Fitzgibbon, "Bundle adjustment — a modern synthesis", 2000 (doi:10.1007/3-540-44480-7_21).
//! Levenberg–Marquardt on the reprojection errors, each under a robust loss, plus a Gaussian prior on any pose: a prior holds
//! gauge and scale, so nothing need be fixed. Every point is seen by cameras only, so points are eliminated one by one (Schur
//! complement, section 6.1) and one dense symmetric system in the poses is left: 6 unknowns a view.
//!
//! A pose T = `world_from_camera` changes on its camera side, T·exp(v, ω). With p = Rᵀ(X − t) the point in the camera:
//! ∂p/∂v = −I, ∂p/∂ω = \[p\]×, ∂p/∂X = Rᵀ. The prior's residual is (R₀ᵀ(t − t₀), log R₀ᵀR) with a 6×6 information matrix.
//!
//! The sums run over fixed chunks of points that are added in order, so the result does not depend on the number of threads.

use nalgebra::{
    DMatrix, DVector, Isometry3, Matrix2x3, Matrix3, Matrix6, Matrix6x3, SMatrix, Translation3, UnitQuaternion, Vector2, Vector3,
    Vector6,
};
use rayon::prelude::*;

use crate::solver::robust_loss::RobustLoss;

/// Points nearer to the image plane than this count as unseen, mm.
const NEAREST_MM: f64 = 1e-6;
/// What an observation behind the camera costs, in squared standard deviations.
const COST_BEHIND: f64 = 1e6;
/// Points that one task eliminates; fixed, so that sums have one order.
const POINTS_PER_CHUNK: usize = 256;

/// Focal lengths and principal point, px.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pinhole {
    /// Focal length along x, px.
    pub fx: f64,
    /// Focal length along y, px.
    pub fy: f64,
    /// Principal point, px.
    pub cx: f64,
    /// Principal point, px.
    pub cy: f64,
}

impl Pinhole {
    /// Where a point of the camera's space is seen; `None` behind the camera.
    pub fn project(&self, p: &Vector3<f64>) -> Option<Vector2<f64>> {
        (p.z > NEAREST_MM).then(|| Vector2::new(self.fx * p.x / p.z + self.cx, self.fy * p.y / p.z + self.cy))
    }

    fn slope(&self, p: &Vector3<f64>) -> Matrix2x3<f64> {
        let z = 1.0 / p.z;
        Matrix2x3::new(
            self.fx * z,
            0.0,
            -self.fx * p.x * z * z,
            0.0,
            self.fy * z,
            -self.fy * p.y * z * z,
        )
    }
}

/// A scene point seen in a view.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Observation {
    /// Index of the view.
    pub view: usize,
    /// Where, px.
    pub pixel: Vector2<f64>,
}

/// A pose that is known beforehand, with its uncertainty.
#[derive(Clone, Debug, PartialEq)]
pub struct PosePrior {
    /// `world_from_camera`.
    pub mean: Isometry3<f64>,
    /// Inverse covariance of (translation mm, rotation rad), in the prior's camera space.
    pub information: Matrix6<f64>,
}

impl PosePrior {
    /// (translation mm, rotation rad) from the prior to `pose`, in the prior's camera space.
    pub fn residual(&self, pose: &Isometry3<f64>) -> Vector6<f64> {
        let inverse = self.mean.rotation.inverse();
        let t = inverse * (pose.translation.vector - self.mean.translation.vector);
        let r = (inverse * pose.rotation).scaled_axis();
        Vector6::new(t.x, t.y, t.z, r.x, r.y, r.z)
    }

    /// Slope of [`Self::residual`] with the pose's camera-side twist.
    fn slope(&self, pose: &Isometry3<f64>) -> Matrix6<f64> {
        let relative = self.mean.rotation.inverse() * pose.rotation;
        let half = relative.scaled_axis() * 0.5;
        let mut slope = Matrix6::zeros();
        slope
            .fixed_view_mut::<3, 3>(0, 0)
            .copy_from(relative.to_rotation_matrix().matrix());
        // Inverse right Jacobian of the rotation group to first order in the (small) deviation.
        slope
            .fixed_view_mut::<3, 3>(3, 3)
            .copy_from(&(Matrix3::identity() + half.cross_matrix()));
        slope
    }
}

/// Unknowns and what is known of them.
#[derive(Clone, Debug)]
pub struct Problem {
    /// The camera of all views.
    pub camera: Pinhole,
    /// `world_from_camera` per view.
    pub poses: Vec<Isometry3<f64>>,
    /// Per view, what is known of its pose beforehand.
    pub priors: Vec<Option<PosePrior>>,
    /// Scene points, mm.
    pub points: Vec<Vector3<f64>>,
    /// Per point, where it was seen; a view at most once.
    pub observations: Vec<Vec<Observation>>,
    /// Standard deviation of an observation, px.
    pub sigma_px: f64,
    /// Loss of observations, in units of `sigma_px`.
    pub loss: RobustLoss,
    /// Loss of priors, in Mahalanobis units.
    pub prior_loss: RobustLoss,
}

/// How it went.
#[derive(Clone, Copy, Debug)]
pub struct Summary {
    /// Accepted steps.
    pub iterations: usize,
    /// Robust cost at the start.
    pub initial_cost: f64,
    /// Robust cost at the end.
    pub final_cost: f64,
    /// True if it ended because nothing improved any more.
    pub converged: bool,
}

/// The twist applied on the camera side of a pose.
fn moved(pose: &Isometry3<f64>, twist: &Vector6<f64>) -> Isometry3<f64> {
    let step = Isometry3::from_parts(
        Translation3::new(twist[0], twist[1], twist[2]),
        UnitQuaternion::from_scaled_axis(Vector3::new(twist[3], twist[4], twist[5])),
    );
    pose * step
}

/// Residual (predicted − observed, px) and its slopes with the pose's twist and with the point.
fn linearized(
    camera: &Pinhole,
    pose: &Isometry3<f64>,
    rotation: &Matrix3<f64>,
    point: &Vector3<f64>,
    pixel: &Vector2<f64>,
) -> Option<(Vector2<f64>, SMatrix<f64, 2, 6>, Matrix2x3<f64>)> {
    let p = rotation.tr_mul(&(point - pose.translation.vector));
    let residual = camera.project(&p)? - pixel;
    let slope = camera.slope(&p);
    let mut by_pose = SMatrix::<f64, 2, 6>::zeros();
    by_pose.fixed_view_mut::<2, 3>(0, 0).copy_from(&(-slope));
    by_pose.fixed_view_mut::<2, 3>(0, 3).copy_from(&(slope * p.cross_matrix()));
    Some((residual, by_pose, slope * rotation.transpose()))
}

/// Poses and points.
type State = (Vec<Isometry3<f64>>, Vec<Vector3<f64>>);

/// What one chunk of points adds to the system in the poses, and what is needed to get the points back.
struct Chunk {
    /// Lower triangle of 6×6 blocks, row by row: block (a, b), a ≥ b, at a(a+1)/2 + b.
    blocks: Vec<Matrix6<f64>>,
    right: Vec<Vector6<f64>>,
    points: Vec<EliminatedPoint>,
}

struct EliminatedPoint {
    inverse: Matrix3<f64>,
    gradient: Vector3<f64>,
    /// View and its 6×3 block.
    coupling: Vec<(usize, Matrix6x3<f64>)>,
}

fn block_index(a: usize, b: usize) -> usize {
    a * (a + 1) / 2 + b
}

impl Problem {
    /// The robust cost of the present state.
    pub fn cost(&self) -> f64 {
        self.cost_of(&self.poses, &self.points)
    }

    fn cost_of(&self, poses: &[Isometry3<f64>], points: &[Vector3<f64>]) -> f64 {
        let weight = 1.0 / (self.sigma_px * self.sigma_px);
        let from_world: Vec<_> = poses.iter().map(Isometry3::inverse).collect();
        let sums: Vec<f64> = points
            .par_iter()
            .zip(self.observations.par_iter())
            .with_min_len(POINTS_PER_CHUNK)
            .map(|(point, seen)| {
                seen.iter()
                    .map(|o| {
                        let p = from_world[o.view].transform_point(&(*point).into()).coords;
                        let s = self
                            .camera
                            .project(&p)
                            .map_or(COST_BEHIND, |q| (q - o.pixel).norm_squared() * weight);
                        self.loss.cost(s)
                    })
                    .sum()
            })
            .collect();
        let priors: f64 = self
            .priors
            .iter()
            .zip(poses)
            .filter_map(|(prior, pose)| Some(self.prior_cost(prior.as_ref()?, pose)))
            .sum();
        sums.iter().sum::<f64>() + priors
    }

    fn prior_cost(&self, prior: &PosePrior, pose: &Isometry3<f64>) -> f64 {
        let r = prior.residual(pose);
        self.prior_loss.cost(r.dot(&(prior.information * r)))
    }

    /// Reprojection error of an observation of `point`, px; `None` behind the camera.
    pub fn error_px(&self, point: usize, observation: &Observation) -> Option<f64> {
        let p = self.poses[observation.view]
            .inverse_transform_point(&self.points[point].into())
            .coords;
        Some((self.camera.project(&p)? - observation.pixel).norm())
    }

    /// Root mean square reprojection error over all observations in front of their cameras, px.
    pub fn rms_px(&self) -> f64 {
        let (mut sum, mut count) = (0.0, 0usize);
        for (i, seen) in self.observations.iter().enumerate() {
            for error in seen.iter().filter_map(|o| self.error_px(i, o)) {
                sum += error * error;
                count += 1;
            }
        }
        (sum / count.max(1) as f64).sqrt()
    }

    /// Improve poses and points until nothing gains, at most `max_iterations` accepted steps.
    pub fn adjust(&mut self, max_iterations: usize) -> Summary {
        let initial_cost = self.cost();
        let mut summary = Summary {
            iterations: 0,
            initial_cost,
            final_cost: initial_cost,
            converged: false,
        };
        let mut damping = 1e-4;
        while summary.iterations < max_iterations {
            let Some((poses, points)) = self.step(damping) else {
                damping *= 10.0;
                if damping > 1e8 {
                    break;
                }
                continue;
            };
            let cost = self.cost_of(&poses, &points);
            if cost.is_finite() && cost <= summary.final_cost {
                let gain = summary.final_cost - cost;
                self.poses = poses;
                self.points = points;
                summary.iterations += 1;
                summary.final_cost = cost;
                damping = (damping * 0.2).max(1e-9);
                if gain <= 1e-6 * cost {
                    summary.converged = true;
                    break;
                }
            } else {
                damping *= 8.0;
                if damping > 1e8 {
                    summary.converged = true;
                    break;
                }
            }
        }
        summary
    }

    /// Poses and points after one damped Gauss–Newton step; `None` if the system is not positive definite.
    fn step(&self, damping: f64) -> Option<State> {
        let views = self.poses.len();
        let rotations: Vec<_> = self.poses.iter().map(|p| *p.rotation.to_rotation_matrix().matrix()).collect();
        let chunk_starts: Vec<usize> = (0..self.points.len()).step_by(POINTS_PER_CHUNK).collect();
        let chunks: Vec<Chunk> = chunk_starts
            .par_iter()
            .map(|start| self.eliminated(*start..(start + POINTS_PER_CHUNK).min(self.points.len()), &rotations, damping))
            .collect();
        let mut blocks = vec![Matrix6::zeros(); views * (views + 1) / 2];
        let mut right = vec![Vector6::zeros(); views];
        for chunk in &chunks {
            blocks.iter_mut().zip(&chunk.blocks).for_each(|(sum, b)| *sum += b);
            right.iter_mut().zip(&chunk.right).for_each(|(sum, r)| *sum += r);
        }
        for (view, (prior, pose)) in self.priors.iter().zip(&self.poses).enumerate() {
            if let Some(prior) = prior {
                let r = prior.residual(pose);
                let slope = prior.slope(pose);
                let weighted = prior.information * self.prior_loss.weight(r.dot(&(prior.information * r)));
                let normal = slope.transpose() * weighted;
                let mut block = normal * slope;
                for d in 0..6 {
                    block[(d, d)] *= 1.0 + damping;
                }
                blocks[block_index(view, view)] += block;
                right[view] -= normal * r;
            }
        }
        let mut system = DMatrix::zeros(6 * views, 6 * views);
        let mut vector = DVector::zeros(6 * views);
        for a in 0..views {
            vector.fixed_rows_mut::<6>(6 * a).copy_from(&right[a]);
            for b in 0..=a {
                system
                    .fixed_view_mut::<6, 6>(6 * a, 6 * b)
                    .copy_from(&blocks[block_index(a, b)]);
            }
            for d in 0..6 {
                // A view that nothing holds stays where it is.
                system[(6 * a + d, 6 * a + d)] += 1e-12;
            }
        }
        // Only the lower triangle is read.
        let solution = system.cholesky()?.solve(&vector);
        let poses = self
            .poses
            .iter()
            .enumerate()
            .map(|(v, pose)| moved(pose, &solution.fixed_rows::<6>(6 * v).into_owned()))
            .collect();
        let mut points = self.points.clone();
        for (point, eliminated) in points.iter_mut().zip(chunks.iter().flat_map(|c| &c.points)) {
            let mut right = -eliminated.gradient;
            for (view, coupling) in &eliminated.coupling {
                right -= coupling.tr_mul(&solution.fixed_rows::<6>(6 * view));
            }
            *point += eliminated.inverse * right;
        }
        Some((poses, points))
    }

    fn eliminated(&self, range: std::ops::Range<usize>, rotations: &[Matrix3<f64>], damping: f64) -> Chunk {
        let views = self.poses.len();
        let mut chunk = Chunk {
            blocks: vec![Matrix6::zeros(); views * (views + 1) / 2],
            right: vec![Vector6::zeros(); views],
            points: Vec::with_capacity(range.len()),
        };
        let scale = 1.0 / (self.sigma_px * self.sigma_px);
        for index in range {
            let point = &self.points[index];
            let mut normal = Matrix3::zeros();
            let mut gradient = Vector3::zeros();
            let mut coupling = Vec::with_capacity(self.observations[index].len());
            for o in &self.observations[index] {
                let Some((residual, by_pose, by_point)) =
                    linearized(&self.camera, &self.poses[o.view], &rotations[o.view], point, &o.pixel)
                else {
                    continue;
                };
                let weight = scale * self.loss.weight(residual.norm_squared() * scale);
                let pose_weighted = by_pose.transpose() * weight;
                let mut block = pose_weighted * by_pose;
                for d in 0..6 {
                    block[(d, d)] *= 1.0 + damping;
                }
                chunk.blocks[block_index(o.view, o.view)] += block;
                chunk.right[o.view] -= pose_weighted * residual;
                normal += by_point.tr_mul(&by_point) * weight;
                gradient += by_point.tr_mul(&residual) * weight;
                coupling.push((o.view, pose_weighted * by_point));
            }
            for d in 0..3 {
                normal[(d, d)] *= 1.0 + damping;
            }
            let inverse = normal
                .try_inverse()
                .filter(|_| coupling.len() >= 2)
                .unwrap_or_else(Matrix3::zeros);
            for (k, (view, left)) in coupling.iter().enumerate() {
                let carried = left * inverse;
                chunk.right[*view] += carried * gradient;
                for (other, block) in &coupling[..=k] {
                    let product = carried * block.transpose();
                    if view >= other {
                        chunk.blocks[block_index(*view, *other)] -= product;
                    } else {
                        chunk.blocks[block_index(*other, *view)] -= product.transpose();
                    }
                }
            }
            chunk.points.push(EliminatedPoint {
                inverse,
                gradient,
                coupling,
            });
        }
        chunk
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt as _, SeedableRng as _};
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution as _, StandardNormal};

    use super::*;

    const CAMERA: Pinhole = Pinhole {
        fx: 860.0,
        fy: 858.0,
        cx: 480.0,
        cy: 270.0,
    };

    fn normal(rng: &mut ChaCha8Rng) -> f64 {
        StandardNormal.sample(rng)
    }

    fn noise_twist(rng: &mut ChaCha8Rng, mm: f64, rad: f64) -> Vector6<f64> {
        Vector6::from_fn(|i, _| normal(rng) * if i < 3 { mm } else { rad })
    }

    fn world(rng: &mut ChaCha8Rng, views: usize, points: usize) -> Problem {
        let poses: Vec<_> = (0..views)
            .map(|i| {
                let a = i as f64 * 0.7;
                let from = Vector3::new(15.0 * a.cos(), 15.0 * a.sin(), 5.0 * (a * 0.6).sin());
                let turn = UnitQuaternion::from_euler_angles(0.12 * a.sin(), -0.12 * a.cos(), 0.05 * a.cos());
                Isometry3::from_parts(Translation3::from(from), turn)
            })
            .collect();
        let points: Vec<_> = (0..points)
            .map(|_| {
                let (x, y): (f64, f64) = (rng.random_range(-25.0..25.0), rng.random_range(-15.0..15.0));
                Vector3::new(x, y, 75.0 + 6.0 * (0.2 * x).sin() + rng.random_range(-3.0..3.0))
            })
            .collect();
        let observations = points
            .iter()
            .map(|p| {
                let seen = poses.iter().enumerate().filter_map(|(view, pose)| {
                    let pixel = CAMERA.project(&pose.inverse_transform_point(&(*p).into()).coords)?;
                    Some(Observation { view, pixel })
                });
                seen.collect()
            })
            .collect();
        Problem {
            camera: CAMERA,
            priors: vec![None; poses.len()],
            poses,
            points,
            observations,
            sigma_px: 0.3,
            loss: RobustLoss::Cauchy { width: 3.0 },
            prior_loss: RobustLoss::Squared,
        }
    }

    #[test]
    fn slopes_agree_with_differences() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let pose = moved(&Isometry3::identity(), &noise_twist(&mut rng, 5.0, 0.3));
        let rotation = *pose.rotation.to_rotation_matrix().matrix();
        let point = Vector3::new(8.0, -6.0, 70.0);
        let pixel = Vector2::new(400.0, 300.0);
        let (_, by_pose, by_point) = linearized(&CAMERA, &pose, &rotation, &point, &pixel).unwrap();
        let residual = |pose: &Isometry3<f64>, point: &Vector3<f64>| {
            CAMERA
                .project(&pose.inverse_transform_point(&(*point).into()).coords)
                .unwrap()
                - pixel
        };
        let h = 1e-6;
        for d in 0..6 {
            let mut twist = Vector6::zeros();
            twist[d] = h;
            let numeric = (residual(&moved(&pose, &twist), &point) - residual(&moved(&pose, &-twist), &point)) / (2.0 * h);
            assert!(
                (numeric - by_pose.column(d)).norm() < 1e-4 * (1.0 + numeric.norm()),
                "pose {d}"
            );
        }
        for d in 0..3 {
            let mut step = Vector3::zeros();
            step[d] = h;
            let numeric = (residual(&pose, &(point + step)) - residual(&pose, &(point - step))) / (2.0 * h);
            assert!(
                (numeric - by_point.column(d)).norm() < 1e-4 * (1.0 + numeric.norm()),
                "point {d}"
            );
        }
        let prior = PosePrior {
            mean: moved(&pose, &noise_twist(&mut rng, 1.0, 0.01)),
            information: Matrix6::identity(),
        };
        let slope = prior.slope(&pose);
        for d in 0..6 {
            let mut twist = Vector6::zeros();
            twist[d] = h;
            let numeric = (prior.residual(&moved(&pose, &twist)) - prior.residual(&moved(&pose, &-twist))) / (2.0 * h);
            assert!((numeric - slope.column(d)).norm() < 1e-3, "prior {d}");
        }
    }

    /// 12 views × 150 points with 0.3 px noise. Sideways steps and turns move the picture alike but for the scene's relief, about
    /// 4 mm of 75 mm (standard deviation): a position is known to 0.3 px · 75 mm / 860 px / √150 / (4/75) = 0.04 mm, and the
    /// turn to that over 75 mm, once exact priors on two views hold the gauge. Four standard deviations are the bound.
    #[test]
    fn poses_come_back_from_noise_and_outliers() {
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        let mut problem = world(&mut rng, 12, 150);
        let truth = problem.clone();
        for view in [0, 6] {
            problem.priors[view] = Some(PosePrior {
                mean: truth.poses[view],
                information: Matrix6::identity() * 1e8,
            });
        }
        for pose in &mut problem.poses {
            *pose = moved(pose, &noise_twist(&mut rng, 0.5, 0.005));
        }
        for point in &mut problem.points {
            *point += Vector3::from_fn(|_, _| normal(&mut rng));
        }
        for seen in &mut problem.observations {
            for o in seen.iter_mut() {
                o.pixel += Vector2::from_fn(|_, _| 0.3 * normal(&mut rng));
                if rng.random_range(0..50) == 0 {
                    o.pixel.x += 25.0;
                }
            }
        }
        let summary = problem.adjust(40);
        assert!(summary.final_cost < 0.5 * summary.initial_cost);
        for (pose, truth) in problem.poses.iter().zip(&truth.poses) {
            let off = pose.inverse() * truth;
            assert!(off.translation.vector.norm() < 0.16, "{} mm", off.translation.vector.norm());
            assert!(off.rotation.angle() < 0.16 / 75.0, "{} rad", off.rotation.angle());
        }
    }

    #[test]
    fn an_inverted_pose_is_not_explained() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let mut problem = world(&mut rng, 6, 60);
        let right = problem.rms_px();
        problem.poses.iter_mut().for_each(|p| *p = p.inverse());
        assert!(right < 1e-9 && problem.rms_px() > 10.0);
    }

    #[test]
    fn priors_alone_place_a_view_that_sees_nothing() {
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        let mut problem = world(&mut rng, 5, 40);
        let truth = problem.poses.clone();
        problem.observations.iter_mut().for_each(|seen| seen.retain(|o| o.view != 3));
        for (prior, mean) in problem.priors.iter_mut().zip(&truth) {
            *prior = Some(PosePrior {
                mean: *mean,
                information: Matrix6::identity() * 1e4,
            });
        }
        problem.poses[3] = moved(&problem.poses[3], &noise_twist(&mut rng, 2.0, 0.02));
        problem.adjust(20);
        assert!((problem.poses[3].inverse() * truth[3]).translation.vector.norm() < 1e-3);
    }
}
