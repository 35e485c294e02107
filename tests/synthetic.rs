//! The simulated operation: what it calls truth is true.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use endofield::camera::distortion::Distortion;
use endofield::geometry::point::Point;
use endofield::geometry::space::{Camera, World};
use endofield::geometry::transform::Transform;
use endofield::progress::Silent;
use endofield::synthetic::airborne::Smoke;
use endofield::synthetic::organs::Anatomy;
use endofield::synthetic::renderer::{Obstacles, Renderer, Shot};
use endofield::synthetic::scene::{Scene, World3d, laparoscope};
use endofield::synthetic::simulation::{Settings, simulate};
use endofield::synthetic::trajectory::{Course, Trajectory};
use nalgebra::Vector3;

const WIDTH: usize = 320;
const HEIGHT: usize = 180;

fn world() -> &'static World3d {
    static WORLD: OnceLock<World3d> = OnceLock::new();
    WORLD.get_or_init(|| World3d::new(Anatomy::GallBladder, 11, WIDTH))
}

fn renderer(noise: f64) -> Renderer {
    Renderer::new(world().clone(), laparoscope(WIDTH, HEIGHT), Some(0.47), noise)
}

fn shot(seconds: f64, obstacles: Obstacles) -> Shot {
    let trajectory = Trajectory::new(Course::Live, 4.0, world().world_from_organs);
    Shot {
        frame: (seconds * 25.0) as u64,
        seconds,
        world_from_camera: trajectory.world_from_camera(seconds),
        exposure: 0.9,
        noise_key: 5,
        obstacles,
    }
}

fn organs_from_camera(shot: &Shot) -> Transform<Scene, Camera> {
    world().world_from_organs.inverse() * shot.world_from_camera
}

/// Walk along the ray in small steps, then halve: the plainest ray cast there is.
fn reference_depth(eye: Vector3<f64>, direction: Vector3<f64>) -> f64 {
    let relief = &world().organs.relief;
    let above = |t: f64| {
        let p = eye + direction * t;
        p.z - relief.height(p.x, p.y).z
    };
    let step = 0.02;
    let mut t = 10.0;
    while above(t + step) > 0.0 {
        t += step;
        assert!(t < 400.0, "no surface");
    }
    let (mut low, mut high) = (t, t + step);
    for _ in 0..40 {
        let middle = 0.5 * (low + high);
        if above(middle) > 0.0 { low = middle } else { high = middle }
    }
    low
}

#[test]
fn depth_is_that_of_a_plain_ray_cast() {
    let renderer = renderer(1.0);
    let shot = shot(1.3, Obstacles::default());
    let truth = renderer.render(&shot, true).truth.unwrap();
    let pose = organs_from_camera(&shot);
    let pinhole = renderer.camera().pinhole();
    let mut compared = 0;
    for y in (3..HEIGHT).step_by(11) {
        for x in (2..WIDTH).step_by(13) {
            let depth = f64::from(truth.depth.at(x, y)) / 100.0;
            if depth == 0.0 {
                continue;
            }
            let pixel = endofield::camera::intrinsics::Pixel {
                x: x as f64,
                y: y as f64,
            };
            let ray = pinhole.unproject(pixel).unwrap();
            let expected = reference_depth(pose.translation(), (pose * ray).coords);
            assert!(
                (depth - expected).abs() < 0.0061,
                "pixel {x},{y}: {depth} mm, ray cast {expected} mm"
            );
            compared += 1;
        }
    }
    assert!(compared > 200, "{compared}");
}

#[test]
fn a_known_point_of_the_surface_is_where_the_depth_map_says() {
    let renderer = renderer(1.0);
    let shot = shot(0.4, Obstacles::default());
    let depth = renderer.render(&shot, true).truth.unwrap().depth;
    let camera_from_organs = organs_from_camera(&shot).inverse();
    let pinhole = renderer.camera().pinhole();
    let (mut visible, mut hidden) = (0, 0);
    for i in 0..400 {
        let (x, y) = (f64::from(i % 20) * 2.0 - 19.0, f64::from(i / 20) * 1.5 - 14.0);
        let on_surface: Point<Scene> = Point::new(x, y, world().organs.relief.height(x, y).z);
        let seen = camera_from_organs * on_surface;
        let Some(pixel) = pinhole.project(seen).filter(|p| pinhole.contains(*p, 2.0)) else {
            continue;
        };
        let (u, v) = (pixel.x.floor() as usize, pixel.y.floor() as usize);
        let corners = [(0, 0), (1, 0), (0, 1), (1, 1)].map(|(a, b)| f64::from(depth.at(u + a, v + b)) / 100.0);
        let nearest = corners.iter().copied().fold(f64::MAX, f64::min);
        let farthest = corners.iter().copied().fold(0.0, f64::max);
        if nearest == 0.0 {
            continue;
        }
        // Nothing is seen in front of the surface, and what is behind it is hidden by it.
        assert!(
            seen.coords.z > nearest - 0.3,
            "{} mm before the surface at {nearest} mm",
            seen.coords.z
        );
        if seen.coords.z <= farthest + 0.3 {
            visible += 1
        } else {
            hidden += 1
        }
    }
    assert!(visible > 200 && hidden < visible / 10, "{visible} visible, {hidden} hidden");
}

#[test]
fn mirror_reflections_only_add_light() {
    let pinhole = endofield::camera::model::CameraModel {
        distortion: Distortion::None,
        ..laparoscope(WIDTH, HEIGHT)
    };
    let renderer = Renderer::new(world().clone(), pinhole, None, 0.0);
    let rendered = renderer.render(&shot(2.0, Obstacles::default()), true);
    let truth = rendered.truth.unwrap();
    for (full, diffuse) in rendered.video.pixels().iter().zip(truth.diffuse.pixels()) {
        for k in 0..3 {
            assert!(full[k] >= diffuse[k], "{full:?} {diffuse:?}");
        }
    }
    // Without a lens, the video minus the diffuse picture is the strength.
    let luma = |p: &[u8; 3]| 0.299 * f64::from(p[0]) + 0.587 * f64::from(p[1]) + 0.114 * f64::from(p[2]);
    for ((full, diffuse), &strength) in rendered
        .video
        .pixels()
        .iter()
        .zip(truth.diffuse.pixels())
        .zip(truth.strength.pixels())
    {
        assert!((luma(full) - luma(diffuse) - f64::from(strength)).abs() <= 1.6);
    }
}

#[test]
fn masks_agree_with_each_other() {
    let renderer = renderer(1.0);
    let obstacles = Obstacles {
        instrument: true,
        particles_per_frame: 10.0,
        smoke: Some(Smoke::new(1, 1.0, 4.0)),
    };
    let rendered = renderer.render(&shot(1.6, obstacles), true);
    let truth = rendered.truth.unwrap();
    let field = renderer.field_mask();
    let mut counts = [0_usize; 3];
    for i in 0..WIDTH * HEIGHT {
        let (specular, strength) = (truth.specular.pixels()[i] > 0, truth.strength.pixels()[i]);
        assert_eq!(specular, strength > 12);
        let instrument = truth.instrument.pixels()[i] > 0;
        assert!(!(instrument && strength > 0));
        if field.pixels()[i] == 0 {
            assert!(truth.depth.pixels()[i] == 0 || strength < 255);
        }
        counts[0] += usize::from(specular);
        counts[1] += usize::from(instrument);
        counts[2] += usize::from(truth.particles.pixels()[i] > 0);
    }
    assert!(counts.iter().all(|&c| c > 20), "{counts:?}");
    // Where no particle is, the picture is the clean one, noise and all.
    let (clean, mask) = rendered.without_particles.unwrap();
    let mut changed = 0;
    for ((seen, clean), &mask) in rendered.video.pixels().iter().zip(clean.pixels()).zip(mask.pixels()) {
        let difference = (0..3).map(|k| seen[k].abs_diff(clean[k])).max().unwrap();
        // The faint rim of a particle is outside the mask.
        assert!(mask > 0 || difference <= 60);
        changed += usize::from(mask > 0 && difference > 8);
    }
    assert!(changed > 20);
}

#[test]
fn what_breathes_moves_and_its_depth_stays_exact() {
    let mut breathing = world().clone();
    breathing.motion.breathing_mm = 3.5;
    let renderer = Renderer::new(breathing.clone(), laparoscope(WIDTH, HEIGHT), None, 0.0);
    let still = shot(0.0, Obstacles::default());
    let out = renderer.render(&still, true).truth.unwrap();
    let breathed_in = Shot { seconds: 2.0, ..still };
    let within = renderer.render(&breathed_in, true).truth.unwrap();
    assert!(out.diffuse.pixels() != within.diffuse.pixels());
    // A moved surface point, mapped back to rest, lies on the surface at rest.
    let pose = organs_from_camera(&still);
    let rest = breathing.motion.rest_from_moved(2.0);
    let pinhole = renderer.camera().pinhole();
    for (x, y) in [(100, 60), (160, 90), (220, 120), (90, 130)] {
        let ray = pinhole
            .unproject(endofield::camera::intrinsics::Pixel {
                x: f64::from(x),
                y: f64::from(y),
            })
            .unwrap();
        let depth = f64::from(within.depth.at(x as usize, y as usize)) / 100.0;
        let moved = (pose * Point::<Camera>::from_coords(ray.coords * depth)).coords;
        let p = rest.linear * moved + rest.offset;
        assert!((p.z - world().organs.relief.height(p.x, p.y).z).abs() < 0.03);
    }
}

fn small_operation(seed: u64) -> Settings {
    Settings {
        seed,
        width: WIDTH,
        height: HEIGHT,
        survey_frames: 6,
        live_frames: 5,
        ..Settings::default()
    }
}

fn files_under(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let (mut files, mut folders) = (BTreeMap::new(), vec![folder.to_owned()]);
    while let Some(next) = folders.pop() {
        for entry in fs::read_dir(&next).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else {
                files.insert(path.strip_prefix(folder).unwrap().to_owned(), fs::read(&path).unwrap());
            }
        }
    }
    files
}

#[test]
fn the_same_seed_gives_the_same_files_whatever_the_threads() {
    let folder = tempfile::tempdir().unwrap();
    let made = |name: &str, threads: usize, seed: u64| {
        let out = folder.path().join(name);
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let summary = pool.install(|| simulate(&out, &small_operation(seed), &Silent)).unwrap();
        assert_eq!(summary.frames, 11);
        (files_under(&out), summary)
    };
    let ((one, summary), (two, _), (other, _)) = (made("a", 1, 3), made("b", 3, 3), made("c", 3, 4));
    assert_eq!(one.len(), two.len());
    for (name, bytes) in &one {
        assert!(two[name] == *bytes, "{} differs", name.display());
    }
    assert!(one[Path::new("truth/live/diffuse/000001.png")] != other[Path::new("truth/live/diffuse/000001.png")]);
    assert!(
        (0.005..0.06).contains(&summary.specular_share),
        "specular share {}",
        summary.specular_share
    );
    assert!(
        (80.0..140.0).contains(&summary.mean_level),
        "mean level {}",
        summary.mean_level
    );
}

fn poses(path: &Path) -> Vec<(f64, Transform<World, Camera>)> {
    let text = fs::read_to_string(path).unwrap();
    let lines = text.lines().filter(|line| !line.starts_with('#'));
    lines
        .map(|line| {
            let n: Vec<f64> = line.split_whitespace().map(|v| v.parse().unwrap()).collect();
            let rotation = nalgebra::UnitQuaternion::from_quaternion(nalgebra::Quaternion::new(n[7], n[4], n[5], n[6]));
            (n[0], Transform::new(rotation, Vector3::new(n[1], n[2], n[3])))
        })
        .collect()
}

#[test]
fn the_arm_is_late_and_noisy_as_stated() {
    let folder = tempfile::tempdir().unwrap();
    let mut settings = small_operation(9);
    settings.survey_frames = 0;
    settings.live_frames = 150;
    settings.width = 64;
    settings.height = 48;
    simulate(folder.path(), &settings, &Silent).unwrap();
    let read = poses(&folder.path().join("live/poses.tum"));
    let exact = poses(&folder.path().join("truth/live/hand_poses.tum"));
    assert_eq!(read.len(), exact.len());
    assert!(read.len() > 300, "{}", read.len());
    let (mut moved, mut turned) = (0.0, 0.0);
    for ((stamp, pose), (true_s, true_pose)) in read.iter().zip(&exact) {
        assert!((stamp - true_s - 0.040).abs() < 1e-6);
        let error = true_pose.inverse() * *pose;
        moved += error.translation().norm_squared();
        turned += error.rotation().scaled_axis().norm_squared();
    }
    let degrees_of_freedom = 3.0 * read.len() as f64;
    // The standard deviation of a standard deviation from n values is 1/√(2n); five of them.
    let slack = 5.0 / (2.0 * degrees_of_freedom).sqrt();
    let position_sigma = (moved / degrees_of_freedom).sqrt();
    assert!((position_sigma / 0.25 - 1.0).abs() < slack, "{position_sigma} mm");
    let rotation_sigma = (turned / degrees_of_freedom).sqrt().to_degrees();
    assert!((rotation_sigma / 0.08 - 1.0).abs() < slack, "{rotation_sigma} degrees");
}

#[test]
fn the_survey_sees_the_field_from_many_sides_at_a_surgeons_pace() {
    let duration_s = 72.0 / 25.0;
    let trajectory = Trajectory::new(Course::Survey, duration_s, world().world_from_organs);
    let organs_from_world = world().world_from_organs.inverse();
    let place = |t: f64| (organs_from_world * trajectory.world_from_camera(t)).translation();
    let focus = Vector3::new(0.0, 0.0, 5.0);
    let (mut length, mut angles, mut distances) = (0.0, Vec::new(), Vec::new());
    for i in 0..72 {
        let t = f64::from(i) / 25.0;
        length += (place(t + 0.04) - place(t)).norm();
        let towards = place(t) - focus;
        angles.push((
            towards.x.atan2(towards.z).to_degrees(),
            towards.y.atan2(towards.z).to_degrees(),
        ));
        distances.push(towards.norm());
    }
    let speed = length / duration_s;
    assert!((12.0..40.0).contains(&speed), "{speed} mm/s");
    let span =
        |values: Vec<f64>| values.iter().copied().fold(f64::MIN, f64::max) - values.iter().copied().fold(f64::MAX, f64::min);
    let across = span(angles.iter().map(|a| a.0).collect());
    let along = span(angles.iter().map(|a| a.1).collect());
    assert!(across > 18.0 && along > 12.0, "{across} × {along} degrees");
    assert!(distances.iter().all(|d| (48.0..105.0).contains(d)), "{distances:?}");
}
