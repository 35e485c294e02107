//! A camera's colors from a chart: the chart is found in the picture ([`regions`], [`detection`]), its patches are measured
//! ([`patches`]), and color correction and uneven light are fitted together ([`fit`]); or a white target tells the white balance
//! ([`white`]). A [`report`] and pictures ([`plot`], [`white_plot`]) say how good it is.

pub mod chart;
pub mod detection;
pub mod example;
pub mod fit;
pub mod model;
pub mod patches;
pub mod plot;
pub mod regions;
pub mod report;
pub mod white;
pub mod white_plot;
