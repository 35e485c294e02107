//! The light field: colour as a function of point and direction, held as posed views over a surface (freeform, unstructured).

pub mod build;
pub mod colmap;
pub mod confidence;
pub mod cross_examination;
pub mod depth;
pub mod error;
pub mod evaluate;
pub mod file;
pub mod mapping;
pub mod photometry;
pub mod ply;
pub mod pose_list;
pub mod prior;
pub mod rasterize;
pub mod refinement;
pub mod renderer;
pub mod reobservation;
pub mod selection;
pub mod surface;
pub mod survey;
pub mod survey_report;
pub mod time_offset;
pub mod tracking;
pub mod triangulation;
pub mod undistort;
pub mod view;
