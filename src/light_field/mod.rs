//! The light field: colour as a function of point and direction, held as posed views over a surface (freeform, unstructured).

pub mod prior;
pub mod refinement;
pub mod reobservation;
pub mod selection;
pub mod survey;
pub mod survey_report;
pub mod time_offset;
pub mod tracking;
pub mod triangulation;
pub mod view;
