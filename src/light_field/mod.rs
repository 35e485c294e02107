//! The light field: colour as a function of point and direction, held as posed views over a surface (freeform, unstructured).

pub mod view;
