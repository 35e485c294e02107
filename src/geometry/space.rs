//! The spaces (coordinate systems) as zero-sized types: a point of one space cannot be given where another is due.

/// The space in which the light field is held; the robot's base as it stood at the survey unless a survey says otherwise.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum World {}

/// A camera: x right, y down, z forward (OpenCV); origin at the centre of projection.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Camera {}

/// The arm's foot.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RobotBase {}

/// The arm's last link, where the scope is plugged in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Hand {}

/// A calibration board: x along its first side, y along the other, z away from who looks at it; origin at its first point.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Board {}
