//! A board found in a picture: which of its corners are seen, and where.

use crate::calibration::board::charuco::Print;
use crate::calibration::board::pattern::{BoardLayout, Pattern};
use crate::calibration::board::placement::Naming;
use crate::calibration::board::{charuco, checkerboard, circles, marker_search, saddle};
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

impl Detection {
    /// The same picture with the board taken the other way up, where it looks the same ([`Naming::UpsideDown`]).
    pub fn other_way_up(&self, layout: &BoardLayout) -> Option<Self> {
        if self.naming != Naming::UpsideDown {
            return None;
        }
        let last = layout.sites().len().checked_sub(1)?;
        let sites = layout.sites();
        let mut turned = self.clone();
        for corner in &mut turned.corners {
            // Row by row from the other end is the half turn.
            corner.site = last.checked_sub(corner.site)?;
            let [x, y] = sites.get(corner.site)?.board_mm;
            corner.board = Point::new(x, y, 0.0);
        }
        turned.corners.sort_by_key(|corner| corner.site);
        Some(turned)
    }
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

/// Darker than this on average, nothing can be made out, gray levels.
const DARK: f32 = 14.0;
/// A pixel this bright is clipped.
const CLIPPED: f32 = 252.0;

/// Why no board may have been found, in half a sentence.
pub fn why_not(image: &Image<Rgb8>, layout: &BoardLayout) -> String {
    let gray = gray_from_rgb(image);
    let count = gray.pixels().len().max(1) as f32;
    let mean = gray.pixels().iter().sum::<f32>() / count;
    let clipped = gray.pixels().iter().filter(|level| **level > CLIPPED).count() as f32 / count;
    if mean < DARK {
        return format!("the picture is dark (mean level {mean:.0} of 255)");
    }
    if clipped > 0.25 {
        return format!("{:.0} % of the picture is clipped: less light or exposure", clipped * 100.0);
    }
    let (found, wanted, what) = match layout.pattern {
        Pattern::Checkerboard => (saddle::saddles(&gray).len(), layout.sites().len(), "checkerboard corners"),
        Pattern::Charuco { dictionary, .. } => {
            let markers = marker_search::markers(&gray, dictionary).len();
            (markers, layout.columns * layout.rows / 2, "markers of the dictionary")
        }
        Pattern::Circles { .. } | Pattern::AsymmetricCircles { .. } => (circles::dots(&gray), layout.sites().len(), "dots"),
    };
    if found < wanted / 2 {
        format!("only {found} {what} stand out, the board has {wanted}: out of focus, too small, hidden, or another board")
    } else {
        format!("{found} {what} stand out, but they do not form this board of {wanted}: check its columns and rows")
    }
}
