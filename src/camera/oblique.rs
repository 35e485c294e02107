//! Oblique scopes: the telescope turns against the camera head, and with it where the camera looks.
//!
//! A 30° or 70° telescope looks aside. Turned by θ about its own axis, the objective swings round that axis, and the picture in the
//! eyepiece, which is part of the telescope, turns on the sensor (Yamaguchi, Nakamoto, Sato et al., Camera model and calibration procedure
//! for oblique-viewing endoscope, MICCAI 2003, doi:10.1007/978-3-540-39903-2_46; Wu and Jaramaz, An easy calibration for oblique-viewing
//! endoscopes, ICRA 2008, doi:10.1109/ROBOT.2008.4543401). Both happen by the same θ, because both ends belong to one rigid tube:
//!
//! - in space, by a rotation about a fixed line (direction `axis`, through `point_mm`), given in the camera's space at θ = 0;
//! - in the picture, by a rotation about a fixed place `center`: the principal point goes round it, and the lens's decentring turns.
//!
//! The camera's axes stay those of the sensor, so with θ = 0 as reference
//!
//! camera_θ ← camera_0 = Rz(θ) · R(axis, point, θ)⁻¹.
//!
//! A straight telescope has its axis along z: then the two cancel and turning changes nothing, as it should. θ is positive when the
//! picture's content turns clockwise on the screen (x toward y). Pixels belong to the sensor, so fx and fy do not turn.

use nalgebra::{Rotation2, Unit, UnitQuaternion, Vector2, Vector3};

use crate::camera::distortion::Distortion;
use crate::camera::file::CameraFault;
use crate::camera::intrinsics::{Intrinsics, Pixel};
use crate::camera::model::CameraModel;
use crate::geometry::space::Camera;
use crate::geometry::transform::Transform;
use crate::yaml::Node;

/// The joint between camera head and telescope.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Oblique {
    /// Direction of the telescope's axis, in the camera's space at angle 0; it points forward.
    pub axis: Unit<Vector3<f64>>,
    /// The point of the axis that lies nearest to the camera at angle 0, mm.
    pub point_mm: Vector3<f64>,
    /// What the picture turns about.
    pub center: Pixel,
}

impl Oblique {
    /// The camera with the telescope turned by `angle_rad`, from the camera at angle 0.
    pub fn camera_at(&self, camera: &CameraModel, angle_rad: f64) -> CameraModel {
        let k = &camera.intrinsics;
        let turn = Rotation2::new(angle_rad);
        // In the plane z = 1, where a turn is a turn even if pixels are not square.
        let offset = turn * Vector2::new((k.cx - self.center.x) / k.fx, (k.cy - self.center.y) / k.fy);
        let distortion = match camera.distortion {
            Distortion::BrownConrady { k, p } => {
                // The decentring 2(d·x)x + r²d has the direction d = (p2, p1).
                let d = turn * Vector2::new(p[1], p[0]);
                Distortion::BrownConrady { k, p: [d.y, d.x] }
            }
            other => other,
        };
        CameraModel {
            intrinsics: Intrinsics {
                cx: self.center.x + k.fx * offset.x,
                cy: self.center.y + k.fy * offset.y,
                ..*k
            },
            distortion,
            ..camera.clone()
        }
    }

    /// Camera at `angle_rad` from camera at 0: `hand_from_camera` at the angle is that at 0 times this one's inverse.
    pub fn turned_from_zero(&self, angle_rad: f64) -> Transform<Camera, Camera> {
        let back = UnitQuaternion::from_axis_angle(&self.axis, -angle_rad);
        let roll = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), angle_rad);
        Transform::new(roll * back, roll * (self.point_mm - back * self.point_mm))
    }

    /// How far aside the telescope looks, rad.
    pub fn obliqueness_rad(&self) -> f64 {
        self.axis.z.clamp(-1.0, 1.0).acos()
    }

    /// As a block of `camera.yaml` that readers of plain cameras pass over.
    pub fn text(&self) -> String {
        let list = |values: &[f64]| Node::List(values.iter().map(|v| Node::Number(*v)).collect());
        let block = Node::Map(vec![
            ("axis".to_owned(), list(self.axis.as_slice())),
            ("point_mm".to_owned(), list(self.point_mm.as_slice())),
            ("center_px".to_owned(), list(&[self.center.x, self.center.y])),
        ]);
        let mut text = "# A telescope that turns against the camera head; all above holds at angle 0.\n".to_owned();
        block.write(&mut text, "oblique", 0);
        text
    }

    /// The block of a camera file, if it has one.
    pub fn from_node(tree: &Node) -> Result<Option<Self>, CameraFault> {
        let Some(block) = tree.get("oblique") else {
            return Ok(None);
        };
        let axis = Vector3::from(numbers::<3>(block, "axis", "oblique: axis")?);
        let point = Vector3::from(numbers::<3>(block, "point_mm", "oblique: point_mm")?);
        let center = numbers::<2>(block, "center_px", "oblique: center_px")?;
        let axis = Unit::try_new(axis, 1e-6).ok_or_else(|| CameraFault::Unexpected {
            key: "oblique: axis",
            expected: "a direction".into(),
            found: "0 0 0".into(),
        })?;
        Ok(Some(Self {
            axis,
            // Only what lies across the axis matters.
            point_mm: point - axis.into_inner() * axis.dot(&point),
            center: Pixel {
                x: center[0],
                y: center[1],
            },
        }))
    }
}

fn numbers<const N: usize>(block: &Node, key: &str, name: &'static str) -> Result<[f64; N], CameraFault> {
    let node = block.get(key).ok_or(CameraFault::Missing {
        key: name,
        hint: "as `endofield calibrate oblique` writes it",
    })?;
    (node.numbers())
        .and_then(|values| <[f64; N]>::try_from(values).ok())
        .filter(|values| values.iter().all(|v| v.is_finite()))
        .ok_or_else(|| CameraFault::Unexpected {
            key: name,
            expected: format!("{N} finite numbers"),
            found: "something else".into(),
        })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::file;
    use crate::geometry::point::Point;

    fn camera() -> CameraModel {
        CameraModel {
            width: 1280,
            height: 720,
            intrinsics: Intrinsics {
                fx: 800.0,
                fy: 810.0,
                cx: 655.0,
                cy: 350.0,
            },
            distortion: Distortion::BrownConrady {
                k: [-0.3, 0.1, 0.0, 0.0, 0.0, 0.0],
                p: [0.002, -0.001],
            },
        }
    }

    fn joint(tilt: f64) -> Oblique {
        Oblique {
            axis: Unit::new_normalize(Vector3::new(0.0, tilt.sin(), tilt.cos())),
            point_mm: Vector3::new(0.3, 0.2, 0.0),
            center: Pixel { x: 640.0, y: 362.0 },
        }
    }

    #[test]
    fn a_straight_telescope_turns_only_about_itself() {
        let straight = Oblique {
            point_mm: Vector3::zeros(),
            ..joint(0.0)
        };
        let motion = straight.turned_from_zero(1.1);
        assert!(motion.rotation().angle() < 1e-12 && motion.translation().norm() < 1e-12);
    }

    #[test]
    fn the_picture_is_that_of_the_turned_telescope() {
        // A point fixed to the telescope is seen at a place that goes round the centre by the angle.
        let (camera, joint, angle) = (camera(), joint(0.5), 0.8);
        let point = Point::<Camera>::new(4.0, -3.0, 30.0);
        let swing = UnitQuaternion::from_axis_angle(&joint.axis, angle);
        // Where that point is, in the camera's space at angle 0, once the telescope has turned.
        let moved = Point::<Camera>::from_coords(swing * (point.coords - joint.point_mm) + joint.point_mm);
        let seen = joint
            .camera_at(&camera, angle)
            .project(joint.turned_from_zero(angle) * moved)
            .unwrap();
        let before = camera.project(point).unwrap();
        let k = camera.intrinsics;
        let plane = |p: Pixel| Vector2::new((p.x - joint.center.x) / k.fx, (p.y - joint.center.y) / k.fy);
        assert!((Rotation2::new(angle) * plane(before) - plane(seen)).norm() < 1e-12);
    }

    #[test]
    fn a_file_carries_the_joint_and_plain_readers_pass_over_it() {
        let (camera, joint) = (camera(), joint(0.6));
        let text = file::camera_info(&camera, "scope") + &joint.text();
        let tree = Node::parse(&text).unwrap();
        let found = Oblique::from_node(&tree).unwrap().unwrap();
        assert!((found.axis.into_inner() - joint.axis.into_inner()).norm() < 1e-12);
        let across = joint.point_mm - joint.axis.into_inner() * joint.axis.dot(&joint.point_mm);
        assert!((found.point_mm - across).norm() < 1e-12 && found.center == joint.center);
        assert_eq!(file::from_node(&tree).unwrap(), camera);
        assert_eq!(
            Oblique::from_node(&Node::parse(&file::camera_info(&camera, "x")).unwrap()).unwrap(),
            None
        );
        let broken = Node::parse("oblique: {axis: [0, 0, 0], point_mm: [0, 0, 0], center_px: [1, 2]}").unwrap();
        assert!(Oblique::from_node(&broken).unwrap_err().to_string().contains("direction"));
    }
}
