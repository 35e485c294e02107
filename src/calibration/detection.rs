//! A board found in a picture: which of its corners are seen, and where.

use crate::calibration::board::{BoardLayout, Pattern};
use crate::calibration::charuco::Print;
use crate::calibration::placement::Naming;
use crate::calibration::{charuco, checkerboard, circles};
use crate::camera::intrinsics::Pixel;
use crate::geometry::point::Point;
use crate::geometry::space::Board;
use crate::image::buffer::{Image, Rgb8};
use crate::image::gradient::gray_from_rgb;

/// A corner or dot that is seen.
#[derive(Clone, Copy, Debug)]
pub struct BoardCorner {
    /// Index into [`BoardLayout::sites`].
    pub site: usize,
    /// Where it lies on the board, mm.
    pub board: Point<Board>,
    /// Where it is seen.
    pub pixel: Pixel,
    /// Standard deviation per axis as the pixels around tell it, px.
    pub sigma_px: f64,
}

/// A board that is seen.
#[derive(Clone, Debug)]
pub struct Detection {
    /// What is seen of it, in the order of the layout's sites.
    pub corners: Vec<BoardCorner>,
    /// How sure it is which corner is which.
    pub naming: Naming,
    /// Of a board of dots: their radius as given or as measured, mm.
    pub dot_radius_mm: Option<f64>,
}

/// The board in a picture, if it is seen.
pub fn detect(image: &Image<Rgb8>, layout: &BoardLayout) -> Option<Detection> {
    detect_in_gray(&gray_from_rgb(image), layout)
}

/// The board in a gray picture (0–255), if it is seen.
pub fn detect_in_gray(gray: &Image<f32>, layout: &BoardLayout) -> Option<Detection> {
    match layout.pattern {
        Pattern::Checkerboard => checkerboard::detect(gray, layout),
        Pattern::Charuco {
            marker_mm,
            dictionary,
            legacy,
        } => charuco::detect(gray, &Print::new(layout, marker_mm, dictionary, legacy), layout),
        Pattern::Circles { diameter_mm } | Pattern::AsymmetricCircles { diameter_mm } => {
            circles::detect(gray, layout, diameter_mm)
        }
    }
}
