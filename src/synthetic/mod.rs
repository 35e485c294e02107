//! A world with known answers: organs, a lamp and a camera on an arm, rendered with the truth beside the pictures.

pub mod airborne;
pub mod arm;
pub mod arm_joints;
pub mod board;
pub mod calibration_scene;
pub mod export;
pub mod instrument;
pub mod light;
pub mod material;
pub mod motion;
pub mod noise;
pub mod organs;
pub mod relief;
pub mod renderer;
pub mod scene;
pub mod sensor;
pub mod simulation;
pub mod trajectory;
pub mod vessels;
