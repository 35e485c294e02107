//! The lens models and the files they come from.

use endofield::camera::distortion::Distortion;
use endofield::camera::file;
use endofield::camera::intrinsics::{Intrinsics, Pixel};
use endofield::camera::model::CameraModel;
use endofield::geometry::point::Point;

fn cameras() -> Vec<CameraModel> {
    let intrinsics = Intrinsics {
        fx: 900.0,
        fy: 905.0,
        cx: 641.5,
        cy: 358.0,
    };
    [
        Distortion::None,
        Distortion::BrownConrady {
            k: [-0.25, 0.07, -0.01, 0.0, 0.0, 0.0],
            p: [0.001, -0.0005],
        },
        Distortion::BrownConrady {
            k: [0.3, -0.05, 0.02, 0.6, -0.03, 0.01],
            p: [0.0004, 0.0007],
        },
        Distortion::KannalaBrandt {
            k: [-0.02, 0.01, -0.004, 0.001],
        },
    ]
    .into_iter()
    .map(|distortion| CameraModel {
        width: 1280,
        height: 720,
        intrinsics,
        distortion,
    })
    .collect()
}

#[test]
fn unprojecting_undoes_projecting() {
    for camera in cameras() {
        for (x, y) in [(0.0, 0.0), (1279.0, 719.0), (640.0, 360.0), (100.5, 650.25)] {
            let direction = camera.unproject(Pixel { x, y }).unwrap();
            let back = camera.project(Point::from_coords(direction.coords * 70.0)).unwrap();
            assert!(
                (back.x - x).abs() < 1e-6 && (back.y - y).abs() < 1e-6,
                "{camera:?} ({x}, {y})"
            );
        }
    }
}

#[test]
fn files_keep_every_digit() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("camera.yaml");
    for camera in cameras() {
        file::write(&path, &camera, "30 degree scope").unwrap();
        assert_eq!(file::read(&path).unwrap(), camera);
    }
}
