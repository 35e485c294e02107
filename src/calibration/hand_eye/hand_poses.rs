//! Where the arm puts its hand at each view.

use crate::geometry::space::{Hand, RobotBase};
use crate::geometry::transform::Transform;

/// Where the hand was at each view.
pub trait HandPoses: Sync {
    /// The hand at a view, had the arm's stamps `offset_s` added and its joints `offsets` (mm or rad). `None` where the arm does not say.
    fn base_from_hand(&self, view: usize, offset_s: f64, offsets: &[f64]) -> Option<Transform<RobotBase, Hand>>;

    /// Joints whose offsets can be found; 0 for an arm that tells poses only.
    fn joints(&self) -> usize {
        0
    }

    /// The hand at a view, its joints taken as told.
    fn as_told(&self, view: usize, offset_s: f64) -> Option<Transform<RobotBase, Hand>> {
        self.base_from_hand(view, offset_s, &vec![0.0; self.joints()])
    }
}

impl HandPoses for Vec<Transform<RobotBase, Hand>> {
    fn base_from_hand(&self, view: usize, _: f64, _: &[f64]) -> Option<Transform<RobotBase, Hand>> {
        self.get(view).copied()
    }
}
