//! tmp
use crate::calibration::board::BoardLayout;
use crate::calibration::detection::Detection;
use crate::calibration::marker::Dictionary;
use crate::image::buffer::Image;
pub fn detect(_: &Image<f32>, _: &BoardLayout, _: f64, _: Dictionary) -> Option<Detection> { None }
