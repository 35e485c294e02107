//! Where the tip of a tracked tool is: the tool turns about its tip, which rests in a hole.
//!
//! The tip t (in the tool) is at one place p (before the tracker) in all poses (R, s): R·t + s = p. That is linear in t and p:
//! `[R −I]·(t, p) = −s`, solved for all poses at once (the "algebraic one-step" of Yaniv 2015, doi:10.1117/12.2081348, who finds it as
//! good as fitting a sphere and more robust to how the tool was moved).

use nalgebra::{DMatrix, DVector, Matrix3, Matrix6, SymmetricEigen, Vector3, Vector6};

use crate::geometry::point::Point;
use crate::geometry::space::{Hand, RobotBase};
use crate::geometry::transform::Transform;

/// Poses off by more than so many deviations are outliers: as with corners of boards.
const OUTLIER_DEVIATIONS: f64 = 6.0;
/// The least poses that leave something to judge by.
pub const LEAST_POSES: usize = 6;
/// Least eigenvalue of the mean of `[R −I]ᵀ[R −I]`: a tool that tilts by an angle of deviation α to all sides has about α²/4.
const LEAST_SPREAD: f64 = 5e-4;

/// The tip and how sure it is.
#[derive(Clone, Debug)]
pub struct Pivot {
    /// The tip in the tool, mm.
    pub tip: Point<Hand>,
    /// Where it rested, mm.
    pub rest: Point<RobotBase>,
    /// Of tip and rest, mm².
    pub covariance: Matrix6<f64>,
    /// Root mean square along an axis of how far the tips are from the place of rest, mm.
    pub rms_mm: f64,
    /// Where each pose's tip is from there, mm.
    pub offsets_mm: Vec<Vector3<f64>>,
    /// Poses much farther off than the middle one.
    pub outliers: Vec<bool>,
}

/// Why no tip was found.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum PivotError {
    /// Too few.
    #[error("expected at least {LEAST_POSES} poses of the tool, found {0}")]
    TooFew(usize),
    /// A pose without meaning.
    #[error("expected finite poses, found none such at number {}", .0 + 1)]
    NotFinite(usize),
    /// The tool hardly turned.
    #[error(
        "the tool hardly turned, or about one axis only: the tip may be anywhere along it. Keep the tip in its hole and tilt the tool \
         by 30° and more to all sides"
    )]
    TooLittleMotion,
}

/// What becomes of outliers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outliers {
    /// They count as the others do.
    Kept,
    /// They are left out, until no more are found.
    LeftOut,
}

/// Find the tip from poses of the tool.
///
/// # Errors
/// If there are too few poses, one is not finite, or they do not tell the tip.
pub fn pivot(poses: &[Transform<RobotBase, Hand>], outliers: Outliers) -> Result<Pivot, PivotError> {
    if let Some(bad) = poses.iter().position(|pose| !pose.is_finite()) {
        return Err(PivotError::NotFinite(bad));
    }
    let mut left_out = vec![false; poses.len()];
    loop {
        let chosen: Vec<_> = (poses.iter().zip(&left_out))
            .filter_map(|(pose, out)| (!out).then_some(pose))
            .collect();
        let found = of_all(&chosen)?;
        let offsets_mm: Vec<Vector3<f64>> = poses.iter().map(|pose| (*pose * found.tip - found.rest).coords).collect();
        let distances_mm: Vec<f64> = offsets_mm.iter().map(Vector3::norm).collect();
        // The middle length of vectors of three normal numbers is 1.54 deviations.
        let mut sorted = distances_mm.clone();
        sorted.sort_by(f64::total_cmp);
        let deviation = sorted.get(sorted.len() / 2).copied().unwrap_or(0.0) / 1.54;
        let distant: Vec<bool> = (distances_mm.iter().zip(&left_out))
            .map(|(&far, &out)| out || far > OUTLIER_DEVIATIONS * deviation.max(1e-6))
            .collect();
        if outliers == Outliers::Kept || distant == left_out {
            return Ok(Pivot {
                offsets_mm,
                outliers: distant,
                ..found
            });
        }
        left_out = distant;
    }
}

/// Least squares; offsets are left empty.
fn of_all(poses: &[&Transform<RobotBase, Hand>]) -> Result<Pivot, PivotError> {
    if poses.len() < LEAST_POSES {
        return Err(PivotError::TooFew(poses.len()));
    }
    let rows = 3 * poses.len();
    let mut matrix = DMatrix::zeros(rows, 6);
    let mut right = DVector::zeros(rows);
    for (i, pose) in poses.iter().enumerate() {
        let rotation = pose.rotation().to_rotation_matrix();
        matrix.fixed_view_mut::<3, 3>(3 * i, 0).copy_from(rotation.matrix());
        matrix.fixed_view_mut::<3, 3>(3 * i, 3).copy_from(&-Matrix3::identity());
        right.fixed_rows_mut::<3>(3 * i).copy_from(&-pose.translation());
    }
    let transposed = matrix.transpose();
    let squares: Matrix6<f64> = (&transposed * &matrix).fixed_view::<6, 6>(0, 0).into_owned();
    let spread = SymmetricEigen::new(squares / poses.len() as f64).eigenvalues.min();
    let inverse = (spread > LEAST_SPREAD).then(|| squares.try_inverse()).flatten();
    let inverse = inverse.ok_or(PivotError::TooLittleMotion)?;
    let answer: Vector6<f64> = inverse * (transposed * &right).fixed_rows::<6>(0).into_owned();
    let residuals = matrix * DVector::from_column_slice(answer.as_slice()) - right;
    let sum = residuals.norm_squared();
    Ok(Pivot {
        tip: Point::new(answer[0], answer[1], answer[2]),
        rest: Point::new(answer[3], answer[4], answer[5]),
        covariance: inverse * (sum / (rows - 6) as f64),
        rms_mm: (sum / rows as f64).sqrt(),
        offsets_mm: Vec::new(),
        outliers: Vec::new(),
    })
}

#[cfg(test)]
mod tests {
    use nalgebra::UnitQuaternion;
    use rand::{RngExt as _, SeedableRng as _};
    use rand_chacha::ChaCha8Rng;
    use rand_distr::StandardNormal;

    use super::*;

    const TIP: [f64; 3] = [-14.0, 394.0, -7.0];
    const REST: [f64; 3] = [-800.0, -85.0, -2100.0];

    /// Poses tilted by up to so much about x and y, turned freely about the tool, with noise of the place.
    fn poses(seed: u64, count: usize, tilts_rad: [f64; 2], noise_mm: f64) -> Vec<Transform<RobotBase, Hand>> {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let [tip, rest] = [TIP, REST].map(Vector3::from);
        (0..count)
            .map(|_| {
                let mut up_to = |most: f64| most * (2.0 * random.random::<f64>() - 1.0);
                let (x, y) = (up_to(tilts_rad[0]), up_to(tilts_rad[1]));
                let rotation = UnitQuaternion::from_scaled_axis(Vector3::new(x, y, 0.0));
                let noise = Vector3::from_fn(|_, _| noise_mm * random.sample::<f64, _>(StandardNormal));
                Transform::new(rotation, rest - rotation * tip + noise)
            })
            .collect()
    }

    #[test]
    fn exact_poses_give_the_exact_tip() {
        let found = pivot(&poses(1, 10, [0.5, 0.5], 0.0), Outliers::LeftOut).unwrap();
        assert!((found.tip.coords - Vector3::from(TIP)).norm() < 1e-9, "{:?}", found.tip);
        assert!((found.rest.coords - Vector3::from(REST)).norm() < 1e-9);
    }

    #[test]
    fn noise_of_the_tracker_is_told_by_the_covariance() {
        let runs = 200;
        let mut sum = 0.0;
        for seed in 0..runs {
            let found = pivot(&poses(seed, 40, [0.5, 0.5], 0.5), Outliers::Kept).unwrap();
            let [tip, rest] = [found.tip.coords - Vector3::from(TIP), found.rest.coords - Vector3::from(REST)];
            let error = Vector6::new(tip.x, tip.y, tip.z, rest.x, rest.y, rest.z);
            sum += error.dot(&(found.covariance.try_inverse().unwrap() * error));
        }
        // Six numbers squared in stated deviations: χ² of 6, its mean over the runs 6 ± 4·√(12/runs); the deviation itself comes from 114
        // residuals, which adds 2/112 to the mean.
        let mean = sum / runs as f64;
        assert!(
            (mean - 6.0 * 114.0 / 112.0).abs() < 4.0 * (12.0 / runs as f64).sqrt(),
            "{mean}"
        );
    }

    #[test]
    fn a_slipped_tip_is_left_out() {
        let mut poses = poses(3, 30, [0.5, 0.5], 0.3);
        poses[7] = Transform::new(poses[7].rotation(), poses[7].translation() + Vector3::new(0.0, 12.0, 5.0));
        let found = pivot(&poses, Outliers::LeftOut).unwrap();
        assert!((0..30).all(|i| found.outliers[i] == (i == 7)), "{:?}", found.offsets_mm);
        assert!((found.offsets_mm[7].norm() - 13.0).abs() < 1.5);
    }

    #[test]
    fn what_does_not_tell_the_tip_is_refused() {
        let refusal = |poses: &[_]| pivot(poses, Outliers::LeftOut).unwrap_err();
        assert_eq!(refusal(&poses(1, 5, [0.5, 0.5], 0.1)), PivotError::TooFew(5));
        for tilts in [[0.5, 0.0], [0.02, 0.02]] {
            assert_eq!(refusal(&poses(1, 30, tilts, 0.1)), PivotError::TooLittleMotion, "{tilts:?}");
        }
        let mut poses = poses(1, 10, [0.5, 0.5], 0.1);
        poses[3] = Transform::new(poses[3].rotation(), Vector3::new(f64::NAN, 0.0, 0.0));
        assert_eq!(refusal(&poses), PivotError::NotFinite(3));
    }
}
