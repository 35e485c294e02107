//! How a view sees a place of the live picture: from which angle, how finely, and whether free of the lamp.

use nalgebra::{Point3, Vector3};

use crate::camera::model::CameraModel;
use crate::geometry::space::{Camera, World};
use crate::geometry::transform::Transform;
use crate::image::wide;
use crate::light_field::mapping::{Mapping, is_unoccluded};
use crate::light_field::view::View;
use crate::stages::specularity_substitution::small_view::SmallView;

/// A view's pixel counts as a clean sighting from this confidence on; below it speaks only where nobody else does.
const HEARD_FROM: u8 = 120;

/// Nearer to a view's border than this share of its width a place is not seen …
const BORDER_SHARE: f32 = 0.02;
/// … and nearer than this share less and less liked.
const INNER_SHARE: f32 = 0.1;
/// What the border costs, rad.
const BORDER_PENALTY: f32 = 0.1;
/// What seeing from twice as far costs, rad.
const RESOLUTION_PENALTY: f32 = 0.3;

/// A pixel of a hole.
#[derive(Clone, Copy, Debug, Default)]
pub struct Place {
    /// Column.
    pub x: f32,
    /// Row.
    pub y: f32,
    /// mm; 0 where there is no hole.
    pub depth: f32,
}

/// So many places are looked at together.
pub const PLACES_AT_ONCE: usize = u64::BITS as usize;

/// How a view sees some places, a bit for each.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Sights {
    /// What it sees at all: what lies in its picture, is not hidden, and not under the view's own specularity.
    pub seen: u64,
    /// What of that does not lie in the haze around one.
    pub clean: u64,
}

/// All views of a light field against one live picture.
#[derive(Clone, Copy, Debug)]
pub struct Views<'a> {
    /// The views.
    pub full: &'a [View],
    /// The same, small.
    pub small: &'a [SmallView],
    /// Where they stand; `None` where one cannot see the frame.
    pub vantages: &'a [Option<Vantage>],
}

impl Views<'_> {
    /// [`Vantage::penalty`] of a view; infinite where it sees nothing.
    #[inline]
    pub fn penalty(&self, view: u16, place: Place) -> f32 {
        let view = usize::from(view);
        (self.vantages[view].as_ref()).map_or(f32::INFINITY, |vantage| vantage.penalty(&self.full[view], place))
    }

    /// [`Vantage::look`] of a view.
    #[inline]
    pub fn look(&self, view: u16, places: &[Place]) -> Sights {
        let view = usize::from(view);
        let vantage = self.vantages[view].as_ref();
        vantage.map_or_else(Sights::default, |vantage| {
            vantage.look(&self.full[view], &self.small[view], places)
        })
    }
}

/// Where a view stands against the live camera.
#[derive(Clone, Copy, Debug)]
pub struct Vantage {
    /// From pixels of the live picture to those of the view.
    pub mapping: Mapping,
    /// The same to those of the small view.
    pub small: Mapping,
    /// The view's optical centre in the live camera's space.
    centre: Vector3<f32>,
    /// The live camera's focal lengths and principal point.
    focal: [f32; 2],
    middle: [f32; 2],
}

impl Vantage {
    /// Of `view`, of which `small` is the small copy, against a picture of `live` taken at `eye`.
    pub fn new(live: &CameraModel, eye: &Transform<World, Camera>, view: &View, small: &SmallView) -> Option<Self> {
        let mapping = Mapping::new(live, eye, view)?;
        let centre = eye.isometry().inverse() * Point3::from(view.world_from_camera.translation());
        let k = &live.intrinsics;
        Some(Self {
            mapping,
            small: mapping.onto_coarser(small.step as f32),
            centre: centre.coords.map(|c| c as f32),
            focal: [k.fx as f32, k.fy as f32],
            middle: [k.cx as f32, k.cy as f32],
        })
    }

    /// Angle between the viewing rays, loss of resolution and nearness to the view's border, rad-like; infinite if not in the view.
    pub fn penalty(&self, view: &View, place: Place) -> f32 {
        let (x, y, depth) = self.mapping.apply(place.x, place.y, place.depth);
        let (width, height) = (view.camera.width as f32, view.camera.height as f32);
        let margin = x.min(y).min(width - 1.0 - x).min(height - 1.0 - y);
        if depth <= 0.0 || margin.is_nan() || margin < BORDER_SHARE * width {
            return f32::INFINITY;
        }
        let to_eye = place.depth
            * Vector3::new(
                (place.x - self.middle[0]) / self.focal[0],
                (place.y - self.middle[1]) / self.focal[1],
                1.0,
            );
        let to_view = to_eye - self.centre;
        let (far, near) = (to_view.norm(), to_eye.norm());
        // The angle from the chord between the two directions, to its third power.
        let chord = (to_view / far - to_eye / near).norm();
        let angle = chord + chord * chord * chord / 24.0;
        let resolution = (far / near - 1.0).max(0.0);
        let border = margin / (INNER_SHARE * width);
        angle + RESOLUTION_PENALTY * resolution + 1e-4 + BORDER_PENALTY * (1.0 - border).max(0.0)
    }

    /// How the view, of which `small` is the small copy, sees each of at most 64 places.
    pub fn look(&self, view: &View, small: &SmallView, places: &[Place]) -> Sights {
        let mut sights = Sights::default();
        wide::run(Look {
            mapping: &self.mapping,
            view,
            small,
            places,
            sights: &mut sights,
        });
        sights
    }
}

/// One view asked for many places.
struct Look<'a> {
    mapping: &'a Mapping,
    view: &'a View,
    small: &'a SmallView,
    places: &'a [Place],
    sights: &'a mut Sights,
}

impl wide::Kernel for Look<'_> {
    #[inline(always)]
    fn run(self) {
        let (width, height) = self.view.image.size();
        let (last_x, last_y) = (width as f32 - 2.0, height as f32 - 2.0);
        let confidences = self.view.confidence.pixels();
        let mut mapped = [(0_usize, 0_usize, 0.0_f32); PLACES_AT_ONCE];
        for (mapped, place) in mapped.iter_mut().zip(self.places) {
            let (x, y, depth) = self.mapping.apply(place.x, place.y, place.depth);
            if depth > 0.0 && x >= 1.0 && y >= 1.0 && x < last_x && y < last_y {
                let (x, y) = ((x + 0.5) as i32 as usize, (y + 0.5) as i32 as usize);
                wide::fetch(confidences, y * width + x);
                self.small.fetch_depth(x, y);
                *mapped = (x, y, depth);
            }
        }
        for (index, (x, y, depth)) in mapped.into_iter().enumerate().filter(|(_, (_, _, depth))| *depth > 0.0) {
            // The view's own confidence: between two lobes it sees less than a small pixel clean.
            let confidence = confidences[y * width + x];
            let is_seen = (confidence > 0) & is_unoccluded(self.small.depth_at(x, y), depth);
            self.sights.seen |= u64::from(is_seen) << index;
            self.sights.clean |= u64::from(is_seen & (confidence >= HEARD_FROM)) << index;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::stages::specularity_substitution::example::{DEPTH, Example, HOLE};

    fn hole() -> Place {
        Place {
            x: HOLE.0 as f32,
            y: HOLE.1 as f32,
            depth: DEPTH,
        }
    }

    #[test]
    fn the_penalty_in_the_middle_of_a_view_is_the_angle() {
        let moves = [(0.0, 0.0), (5.0, 0.0), (0.0, -12.0), (20.0, 6.0)];
        let example = Example::new(&moves, [1.0; 3], (0.0, 0.0));
        for ((vantage, view), at) in example.vantages().iter().zip(&example.light_field.views).zip(moves) {
            // The hole lies all but on the axis.
            let away = f64::from(at.0).hypot(f64::from(at.1));
            let (angle, far) = ((away / f64::from(DEPTH)).atan(), away.hypot(f64::from(DEPTH)));
            let expected = angle as f32 + RESOLUTION_PENALTY * (far as f32 / DEPTH - 1.0);
            let found = vantage.unwrap().penalty(view, hole());
            assert!((found - expected).abs() < 0.003, "{found} for {expected}");
        }
    }

    #[test]
    fn what_is_dazzled_or_hidden_is_not_seen() {
        let mut example = Example::new(&[(2.0, 0.0); 4], [1.0; 3], (0.0, 0.0));
        example.light_field.views[1].confidence.fill(60);
        example.light_field.views[2].confidence.fill(0);
        example.light_field.views[3].depth.fill(0.8 * DEPTH);
        example.look_again();
        let vantages = example.vantages();
        let views = example.views(&vantages);
        // The place in the middle of the hole, twice.
        let sights = [0, 1, 2, 3]
            .map(|view| views.look(view, &[hole(); 2]))
            .map(|sights| (sights.seen, sights.clean));
        assert_eq!(sights, [(3, 3), (3, 0), (0, 0), (0, 0)]);
    }
}
