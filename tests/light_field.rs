//! The light field on a scene with known answers: a bumpy textured surface under a lamp that rides on the camera.

use std::fs;
use std::path::Path;

use endofield::camera::distortion::Distortion;
use endofield::camera::intrinsics::Intrinsics;
use endofield::camera::model::CameraModel;
use endofield::geometry::point::Point;
use endofield::geometry::space::{Camera, World};
use endofield::geometry::transform::Transform;
use endofield::image::buffer::{Image, Rgb8};
use endofield::light_field::build::{BuildSettings, complete, open, view_of};
use endofield::light_field::evaluate::leave_one_out;
use endofield::light_field::file::{Origin, read, save};
use endofield::light_field::rasterize::DepthRasterizer;
use endofield::light_field::renderer::Renderer;
use endofield::light_field::view::LightField;
use endofield::progress::Silent;
use endofield::time::Timestamp;
use nalgebra::{Rotation3, UnitQuaternion, Vector3};
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

const WIDTH: usize = 240;
const HEIGHT: usize = 160;

fn camera() -> CameraModel {
    CameraModel {
        width: WIDTH,
        height: HEIGHT,
        intrinsics: Intrinsics {
            fx: 216.0,
            fy: 215.0,
            cx: 121.3,
            cy: 78.2,
        },
        distortion: Distortion::None,
    }
}

fn height(x: f64, y: f64) -> f64 {
    75.0 + 3.0 * (x / 11.0).sin() * (y / 9.0).cos() + 0.05 * x
}

/// Smooth value noise of unit amplitude.
fn noise(x: f64, y: f64, seed: u64) -> f64 {
    let lattice = |i: i64, j: i64| {
        let mut h = (i as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ (j as u64).wrapping_mul(0xc2b2_ae3d_27d4_eb4f) ^ seed;
        h = (h ^ (h >> 31)).wrapping_mul(0xd6e8_feb8_6659_fd93);
        h = (h ^ (h >> 32)).wrapping_mul(0xd6e8_feb8_6659_fd93);
        ((h >> 11) as f64) / (1_u64 << 53) as f64 * 2.0 - 1.0
    };
    let (i, j) = (x.floor(), y.floor());
    let smooth = |t: f64| t * t * (3.0 - 2.0 * t);
    let (a, b) = (smooth(x - i), smooth(y - j));
    let (i, j) = (i as i64, j as i64);
    let upper = lattice(i, j) * (1.0 - a) + lattice(i + 1, j) * a;
    let lower = lattice(i, j + 1) * (1.0 - a) + lattice(i + 1, j + 1) * a;
    upper * (1.0 - b) + lower * b
}

fn reflectance(x: f64, y: f64) -> Vector3<f64> {
    let n = 0.5 * noise(x / 4.0, y / 4.0, 1) + 0.35 * noise(x / 1.7, y / 1.7, 2) + 0.15 * noise(x / 0.9, y / 0.9, 3);
    Vector3::new(0.55 + 0.10 * n, 0.30 + 0.17 * n, 0.24 + 0.12 * n)
}

/// The picture and the exact depth from a pose.
fn shot(pose: &Transform<World, Camera>, exposure: f64, seed: u64) -> (Image<Rgb8>, Image<f32>) {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let k = camera().intrinsics;
    let mut image = Image::filled(WIDTH, HEIGHT, [0; 3]);
    let mut depth = Image::filled(WIDTH, HEIGHT, 0.0);
    let eye = pose.translation();
    for v in 0..HEIGHT {
        for u in 0..WIDTH {
            let local = Vector3::new((u as f64 - k.cx) / k.fx, (v as f64 - k.cy) / k.fy, 1.0);
            let ray = pose.rotation() * local;
            let mut t = 70.0;
            for _ in 0..30 {
                let p = eye + ray * t;
                t += (height(p.x, p.y) - p.z) / ray.z;
            }
            let p = eye + ray * t;
            // Falloff of a small lamp beside the lens.
            let light = exposure * 1.4 * (75.0 / (p - eye).norm()).powi(2);
            let color = reflectance(p.x, p.y).map(|r| {
                let level = 255.0 * (r * light).clamp(0.0, 1.0).powf(1.0 / 2.2) + random.random_range(-1.5..1.5);
                level.round().clamp(0.0, 255.0) as u8
            });
            image.set(u, v, [color.x, color.y, color.z]);
            depth.set(u, v, t as f32);
        }
    }
    (image, depth)
}

/// Looks from (x, y, z) at the middle of the scene.
fn pose(x: f64, y: f64, z: f64) -> Transform<World, Camera> {
    let from = Vector3::new(x, y, z);
    let forward = (Vector3::new(0.0, 0.0, 75.0) - from).normalize();
    let right = Vector3::y().cross(&forward).normalize();
    let rotation = Rotation3::from_basis_unchecked(&[right, forward.cross(&right), forward]);
    Transform::new(UnitQuaternion::from_rotation_matrix(&rotation), from)
}

fn survey() -> (LightField, Vec<f64>) {
    let mut light_field = LightField::default();
    let mut exposures = Vec::new();
    for i in 0..12_u32 {
        let angle = f64::from(i) * 0.9;
        let radius = 6.0 + 9.0 * f64::from(i % 3) / 2.0;
        let exposure = 1.0 + 0.12 * (f64::from(i) * 1.3).sin();
        let pose = pose(radius * angle.cos(), radius * angle.sin(), 5.0 * (f64::from(i) * 0.7).sin());
        let (image, _) = shot(&pose, exposure, u64::from(i));
        light_field.views.push(view_of(
            i * 3,
            Timestamp::from_seconds(0.04 * f64::from(i)),
            &image,
            &camera(),
            pose,
        ));
        exposures.push(exposure);
    }
    (light_field, exposures)
}

/// Narrower than real pictures, so the search starts where these views can see.
fn settings() -> BuildSettings {
    let mut settings = BuildSettings::default();
    settings.stereo.nearest_mm = 50.0;
    settings.stereo.farthest_mm = 120.0;
    settings.surface.triangles = 12_000;
    settings
}

#[test]
fn depth_gains_pictures_and_files() {
    let (mut light_field, exposures) = survey();
    let report = complete(&mut light_field, &settings(), &Silent).unwrap();
    assert!(report.coverage > 0.9, "{report:?}");
    // At 216 px focal length and 15 mm baselines a tenth of a pixel is 0.17 mm.
    let mut rasterizer = DepthRasterizer::new();
    let mut found = Image::filled(0, 0, 0.0);
    let between = pose(3.0, -4.0, 1.0);
    let (truth, depth) = shot(&between, 1.0, 99);
    rasterizer.render(&light_field.surface, &camera(), &between, &mut found);
    let (mut squares, mut count) = (0.0, 0.0);
    for (a, b) in found.pixels().iter().zip(depth.pixels()).filter(|(a, _)| **a > 0.0) {
        squares += f64::from(a - b).powi(2);
        count += 1.0;
    }
    let rms = (squares / count).sqrt();
    assert!(rms < 0.3, "depth error {rms} mm rms over {count} pixels");

    // Exposures come back up to a common factor; sRGB values go with exposure^(1/2.2).
    let relative: Vec<f64> = light_field
        .views
        .iter()
        .zip(&exposures)
        .map(|(v, e)| f64::from(v.gain[1]).ln() + e.ln() / 2.2)
        .collect();
    let mean = relative.iter().sum::<f64>() / relative.len() as f64;
    assert!(relative.iter().all(|r| (r - mean).abs() < 0.02), "{relative:?}");
    assert!(
        (light_field.shading.falloff - 2.0 / 2.2).abs() < 0.25,
        "{:?}",
        light_field.shading
    );

    let mut renderer = Renderer::new(&light_field);
    let (mut picture, mut valid) = (Image::filled(0, 0, [0; 3]), Image::filled(0, 0, 0));
    renderer.render(&light_field, &camera(), &between, &mut picture, &mut valid);
    let seen = valid.pixels().iter().filter(|&&v| v != 0).count();
    assert!(seen as f64 > 0.9 * (WIDTH * HEIGHT) as f64, "{seen}");
    let error: f64 = (picture.pixels().iter().zip(truth.pixels()).zip(valid.pixels()))
        .filter(|(_, v)| **v != 0)
        .map(|((a, b), _)| (f64::from(a[1]) - f64::from(b[1])).powi(2))
        .sum();
    let psnr = 10.0 * (65025.0 / (error / seen as f64)).log10();
    assert!(psnr > 33.0, "{psnr} dB");

    let evaluation = leave_one_out(&light_field, &Silent);
    assert!(
        evaluation.mean.texture_psnr > 33.0 && evaluation.mean.ssim > 0.9,
        "{:?}",
        evaluation.mean
    );

    let folder = tempfile::tempdir().unwrap();
    save(&light_field, folder.path(), &Silent).unwrap();
    comes_back(&light_field, folder.path());
    faults_are_named(folder.path());
}

fn comes_back(light_field: &LightField, folder: &Path) {
    let loaded = read(folder, &Silent).unwrap();
    assert_eq!(loaded.origin, Origin::Endofield);
    let back = loaded.light_field;
    assert_eq!(back.views.len(), light_field.views.len());
    assert_eq!(back.shading, light_field.shading);
    assert_eq!(back.surface.triangles, light_field.surface.triangles);
    for (a, b) in back.views.iter().zip(&light_field.views) {
        assert_eq!(
            (a.frame_number, &a.image, &a.confidence, a.gain, a.exposed_at),
            (b.frame_number, &b.image, &b.confidence, b.gain, b.exposed_at)
        );
        assert!(
            a.depth
                .pixels()
                .iter()
                .zip(b.depth.pixels())
                .all(|(a, b)| (a - b).abs() <= 0.0051)
        );
        let apart = a.world_from_camera.inverse() * b.world_from_camera;
        assert!(apart.translation().norm() < 1e-9 && apart.rotation().angle() < 1e-7);
    }
}

fn faults_are_named(folder: &Path) {
    let nothing = tempfile::tempdir().unwrap();
    assert!(
        read(nothing.path(), &Silent)
            .unwrap_err()
            .to_string()
            .contains("light-field build")
    );
    let depth = folder.join("depth/000006.png");
    let bytes = fs::read(&depth).unwrap();
    fs::write(&depth, &bytes[..bytes.len() / 2]).unwrap();
    assert!(read(folder, &Silent).unwrap_err().to_string().contains("depth/000006.png"));
    fs::write(&depth, bytes).unwrap();
    let image = folder.join("images/000003.png");
    fs::remove_file(&image).unwrap();
    let error = read(folder, &Silent).unwrap_err().to_string();
    assert!(error.contains("images/000003.png") && error.contains("not there"), "{error}");
    fs::copy(folder.join("confidence/000000.png"), &image).unwrap();
    assert!(read(folder, &Silent).is_ok());
    fs::write(&image, b"no picture").unwrap();
    assert!(read(folder, &Silent).is_err());
}

#[test]
fn a_colmap_model_made_elsewhere_opens() {
    let (light_field, _) = survey();
    let folder = tempfile::tempdir().unwrap();
    save(&light_field, folder.path(), &Silent).unwrap();
    for part in ["light_field.toml", "surface.ply"] {
        fs::remove_file(folder.path().join(part)).unwrap();
    }
    for part in ["confidence", "depth"] {
        fs::remove_dir_all(folder.path().join(part)).unwrap();
    }
    let opened = open(folder.path(), &settings(), &Silent).unwrap();
    assert_eq!(opened.views.len(), 12);
    assert!(opened.surface.triangles.len() > 1000);
    assert!(opened.views[4].depth.at(WIDTH / 2, HEIGHT / 2) > 60.0);
}

#[test]
fn too_few_views_say_so() {
    let (mut light_field, _) = survey();
    light_field.views.truncate(1);
    let error = complete(&mut light_field, &settings(), &Silent).unwrap_err();
    assert!(error.to_string().contains("at least 2 views"), "{error}");
}

#[test]
fn a_sample_is_the_tissue_and_not_the_specularity_on_it() {
    let (mut light_field, _) = survey();
    // A white spot in the middle of every second view, which its own detector must silence.
    for view in light_field.views.iter_mut().step_by(2) {
        for y in 70..80 {
            for x in 115..127 {
                view.image.set(x, y, [250, 248, 246]);
            }
        }
        let image = view.image.clone();
        *view = view_of(view.frame_number, view.exposed_at, &image, &camera(), view.world_from_camera);
    }
    complete(&mut light_field, &settings(), &Silent).unwrap();
    let mut renderer = Renderer::new(&light_field);
    let point = Point::new(0.0, 0.0, height(0.0, 0.0));
    let from = light_field.views[0].world_from_camera.origin();
    let sample = renderer.sample(&light_field, &point, &from).unwrap();
    assert!(sample.color[0] < 235.0 && sample.color[1] < 190.0, "{sample:?}");
    assert!(renderer.sample(&light_field, &Point::new(500.0, 0.0, 75.0), &from).is_none());
}
