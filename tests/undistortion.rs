//! Undistortion against OpenCV's own, see fixtures/golden/undistortion/README.md.

use std::path::PathBuf;

use endofield::camera::distortion::Distortion;
use endofield::camera::file;
use endofield::camera::intrinsics::Intrinsics;
use endofield::camera::model::CameraModel;
use endofield::camera::undistortion;
use endofield::image::buffer::{Image, Rgb8};
use endofield::image::remap::Interpolation;

fn golden(name: &str) -> PathBuf {
    [env!("CARGO_MANIFEST_DIR"), "fixtures/golden/undistortion", name]
        .iter()
        .collect()
}

fn picture(name: &str) -> Image<Rgb8> {
    let picture = image::open(golden(name)).unwrap().to_rgb8();
    let (width, height) = (picture.width() as usize, picture.height() as usize);
    Image::from_vec(width, height, picture.pixels().map(|p| p.0).collect()).unwrap()
}

fn cameras() -> Vec<(&'static str, CameraModel)> {
    let intrinsics = Intrinsics {
        fx: 115.0,
        fy: 116.5,
        cx: 81.3,
        cy: 58.6,
    };
    let with = |distortion| CameraModel {
        width: 160,
        height: 120,
        intrinsics,
        distortion,
    };
    vec![
        (
            "plumb_bob",
            with(Distortion::BrownConrady {
                k: [-0.31, 0.12, -0.018, 0.0, 0.0, 0.0],
                p: [0.0012, -0.0007],
            }),
        ),
        (
            "rational_polynomial",
            with(Distortion::BrownConrady {
                k: [0.42, -0.11, 0.03, 0.71, -0.09, 0.02],
                p: [0.0008, 0.0004],
            }),
        ),
        (
            "equidistant",
            with(Distortion::KannalaBrandt {
                k: [-0.021, 0.013, -0.006, 0.001],
            }),
        ),
    ]
}

/// Share of pixels that differ by more than one level in any channel.
fn share_beyond_one(a: &Image<Rgb8>, b: &Image<Rgb8>) -> f64 {
    assert_eq!(a.size(), b.size());
    let differs = |(p, q): &(&Rgb8, &Rgb8)| (0..3).any(|c| p[c].abs_diff(q[c]) > 1);
    a.pixels().iter().zip(b.pixels()).filter(differs).count() as f64 / a.pixels().len() as f64
}

#[test]
fn maps_agree_to_a_32nd_of_a_pixel() {
    for (name, camera) in cameras() {
        let table = undistortion::table(&camera, &camera.pinhole()).unwrap();
        let bytes = std::fs::read(golden(&format!("{name}_map.f32"))).unwrap();
        let map: Vec<f32> = bytes
            .chunks_exact(4)
            .map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]]))
            .collect();
        let (mut compared, mut worst) = (0, 0.0_f64);
        for (i, pair) in map.chunks_exact(2).enumerate() {
            let (x, y) = (4 * (i % 40), 4 * (i / 40));
            let Some((sx, sy)) = table.position(x, y) else { continue };
            worst = worst
                .max((sx - f64::from(pair[0])).abs())
                .max((sy - f64::from(pair[1])).abs());
            compared += 1;
        }
        assert!(worst <= 1.0 / 32.0, "{name}: {worst} px");
        assert!(compared > 900, "{name}: only {compared} places in the source");
    }
}

#[test]
fn pictures_agree_to_a_level() {
    let source = picture("source.png");
    let mut out = Image::filled(0, 0, [0; 3]);
    for (name, camera) in cameras() {
        let table = undistortion::table(&camera, &camera.pinhole()).unwrap();
        table.remap_rgb(&source, &mut out, Interpolation::Bilinear).unwrap();
        let share = share_beyond_one(&out, &picture(&format!("{name}_bilinear.png")));
        assert!(share <= 0.001, "{name}: {share}");
        if name == "plumb_bob" {
            table.remap_rgb(&source, &mut out, Interpolation::Bicubic).unwrap();
            let share = share_beyond_one(&out, &picture("plumb_bob_bicubic.png"));
            assert!(share <= 0.001, "{name}, bicubic: {share}");
        }
    }
}

#[test]
fn the_camera_file_of_opencv_is_the_same_camera() {
    let camera = file::read(&golden("opencv.yaml")).unwrap();
    let (_, expected) = &cameras()[1];
    assert_eq!(&camera, expected);
}
