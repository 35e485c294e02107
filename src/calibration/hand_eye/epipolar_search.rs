//! A first X from pairs of views, with no idea of the answer: for a rotation, the epipolar constraint is linear in X's shift; rotations are
//! tried all over.

use nalgebra::{Matrix3, UnitQuaternion, Vector3};
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;
use rayon::prelude::*;

use crate::calibration::hand_eye::hand_poses::HandPoses;
use crate::calibration::hand_eye::view_pairs::{STEPS, ViewPair, essential, sampson};
use crate::geometry::space::{Camera, Hand};
use crate::geometry::transform::Transform;
use crate::solver::robust_loss::RobustLoss;

/// Rotations tried: about 12° from one to the next.
const TRIED: usize = 4000;
/// Of which so many are refined.
const REFINED: usize = 48;
/// Places of a pair that the search looks at.
const LOOKED_AT: usize = 12;
/// The search's robust width, as an angle.
const SEARCH_WIDTH_RAD: f64 = 0.004;

/// An X to begin with: nothing of it needs to be known.
pub fn search(pairs: &[ViewPair], hands: &dyn HandPoses) -> Vec<Transform<Hand, Camera>> {
    // Only pairs some way apart tell much.
    let motions: Vec<(Transform<Hand, Hand>, &ViewPair)> = (pairs.iter())
        .filter(|pair| pair.second - pair.first >= STEPS[1])
        .filter_map(|pair| {
            let [first, second] = [pair.first, pair.second].map(|view| hands.as_told(view, 0.0));
            Some((second?.inverse() * first?, pair))
        })
        .collect();
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let rotations: Vec<UnitQuaternion<f64>> = (0..TRIED)
        .map(|_| {
            let mut draw = || random.sample::<f64, _>(StandardNormal);
            UnitQuaternion::from_quaternion(nalgebra::Quaternion::new(draw(), draw(), draw(), draw()))
        })
        .collect();
    let mut tried: Vec<(f64, Transform<Hand, Camera>)> = (rotations.par_iter())
        .filter_map(|rotation| {
            let shift = shift_for(rotation, &motions)?;
            let x = Transform::new(*rotation, shift);
            Some((misfit(&x, &motions), x))
        })
        .collect();
    tried.sort_by(|a, b| a.0.total_cmp(&b.0));
    tried.into_iter().take(REFINED).map(|(_, x)| x).collect()
}

/// A camera is within an arm's length of the hand: deviation along an axis. Without it, views that hardly tell X's shift let it run away.
pub(super) const REACH_MM: f64 = 300.0;

/// For a rotation of X, nᵀ·R_Xᵀ·((R_A − 1)·t_X + t_A) = 0 for all places, n = (R_B·x_i) × x_j: least squares, twice, the second time
/// with less weight for what fits badly. A weak prior keeps X within reach where the motion does not tell it.
fn shift_for(rotation: &UnitQuaternion<f64>, motions: &[(Transform<Hand, Hand>, &ViewPair)]) -> Option<Vector3<f64>> {
    let turn = rotation.to_rotation_matrix();
    let mut shift = Vector3::zeros();
    for round in 0..2 {
        let (mut normal, mut right) = (Matrix3::identity() * (1e-3 / (REACH_MM * REACH_MM)), Vector3::zeros());
        for (motion, pair) in motions {
            let hand = motion.rotation().to_rotation_matrix();
            let camera = turn.transpose() * hand * turn;
            let lever: Matrix3<f64> = hand.matrix() - Matrix3::identity();
            for [from, to] in spread(&pair.rays) {
                let across = turn * (camera * from).cross(to);
                let (row, constant) = (lever.transpose() * across, across.dot(&motion.translation()));
                let weight = if round == 0 {
                    1.0
                } else {
                    let off = row.dot(&shift) + constant;
                    1.0 / (1.0 + (off / (across.norm() * motion.translation().norm() * 0.1 + 1e-12)).powi(2))
                };
                normal += weight * row * row.transpose();
                right -= weight * constant * row;
            }
        }
        shift = normal.cholesky()?.solve(&right);
    }
    Some(shift)
}

/// A few places of a pair: old tracks and young ones lie in different parts of the picture.
fn spread(rays: &[[Vector3<f64>; 2]]) -> impl Iterator<Item = &[Vector3<f64>; 2]> {
    rays.iter().step_by(rays.len().div_ceil(LOOKED_AT).max(1))
}

fn misfit(x: &Transform<Hand, Camera>, motions: &[(Transform<Hand, Hand>, &ViewPair)]) -> f64 {
    let loss = RobustLoss::Cauchy { width: 1.0 };
    (motions.iter())
        .flat_map(|(motion, pair)| {
            let essential = essential(&(x.inverse() * *motion * *x));
            spread(&pair.rays).map(move |rays| sampson(&essential, rays) / SEARCH_WIDTH_RAD)
        })
        .map(|distance| loss.cost(distance * distance))
        .sum()
}
