//! COLMAP's sparse models (Schönberger and Frahm 2016): cameras, images and points as text or binary files.
//!
//! COLMAP stores camera_from_world with the quaternion's w first, and counts pixels from the top-left *corner*, so the centre
//! of the first pixel is (0.5, 0.5); here it is (0, 0). The shift happens in this file and nowhere else.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};

use nalgebra::{Quaternion, UnitQuaternion, Vector3};

use crate::camera::distortion::Distortion;
use crate::camera::intrinsics::{Intrinsics, Pixel};
use crate::camera::model::CameraModel;
use crate::geometry::point::Point;
use crate::geometry::space::{Camera, World};
use crate::geometry::transform::Transform;
use crate::light_field::error::LightFieldError;

/// One picture of a model.
#[derive(Clone, Debug)]
pub struct ColmapImage {
    /// COLMAP's number of it.
    pub id: u32,
    /// Its file, relative to the folder of pictures.
    pub name: String,
    /// Which camera took it.
    pub camera_id: u32,
    /// Where it was.
    pub world_from_camera: Transform<World, Camera>,
}

/// One triangulated point.
#[derive(Clone, Debug)]
pub struct ColmapPoint {
    /// Where it is.
    pub position: Point<World>,
    /// Image id and pixel of each observation; empty when the model does not say.
    pub observations: Vec<(u32, Pixel)>,
}

/// A sparse model.
#[derive(Clone, Debug, Default)]
pub struct ColmapModel {
    /// Cameras by id.
    pub cameras: BTreeMap<u32, CameraModel>,
    /// Images in the order of their ids.
    pub images: Vec<ColmapImage>,
    /// Points.
    pub points: Vec<ColmapPoint>,
}

/// Where in `folder` a model lies: `sparse/`, `sparse/0/` or the folder itself.
pub fn model_folder(folder: &Path) -> Option<PathBuf> {
    [folder.join("sparse"), folder.join("sparse").join("0"), folder.to_path_buf()]
        .into_iter()
        .find(|f| {
            ["txt", "bin"]
                .iter()
                .any(|e| f.join(format!("cameras.{e}")).is_file() && f.join(format!("images.{e}")).is_file())
        })
}

/// Model name, COLMAP's number, count of parameters.
const MODELS: [(&str, i32, usize); 7] = [
    ("SIMPLE_PINHOLE", 0, 3),
    ("PINHOLE", 1, 4),
    ("SIMPLE_RADIAL", 2, 4),
    ("RADIAL", 3, 5),
    ("OPENCV", 4, 8),
    ("OPENCV_FISHEYE", 5, 8),
    ("FULL_OPENCV", 6, 12),
];

/// A camera by COLMAP's model name and parameters.
pub(crate) fn camera_model(name: &str, width: usize, height: usize, p: &[f64]) -> Result<CameraModel, String> {
    let known = || MODELS.map(|(n, ..)| n).join(", ");
    let &(_, _, count) = MODELS.iter().find(|(n, ..)| *n == name).ok_or_else(|| {
        format!(
            "the camera model {name} is unknown here; expected one of {} (COLMAP's image_undistorter makes PINHOLE)",
            known()
        )
    })?;
    if p.len() != count || !p.iter().all(|v| v.is_finite()) {
        return Err(format!("expected {count} finite parameters for {name}, found {}", p.len()));
    }
    if width == 0 || height == 0 || p[0] <= 0.0 {
        return Err(format!(
            "expected a picture size and a focal length above 0, found {width}×{height} and {}",
            p[0]
        ));
    }
    let one_focal = matches!(name, "SIMPLE_PINHOLE" | "SIMPLE_RADIAL" | "RADIAL");
    let (fx, fy, rest) = if one_focal {
        (p[0], p[0], &p[1..])
    } else {
        (p[0], p[1], &p[2..])
    };
    let intrinsics = Intrinsics {
        fx,
        fy,
        cx: rest[0] - 0.5,
        cy: rest[1] - 0.5,
    };
    let lens = &rest[2..];
    let distortion = match name {
        "SIMPLE_RADIAL" => Distortion::BrownConrady {
            k: [lens[0], 0.0, 0.0, 0.0, 0.0, 0.0],
            p: [0.0; 2],
        },
        "RADIAL" => Distortion::BrownConrady {
            k: [lens[0], lens[1], 0.0, 0.0, 0.0, 0.0],
            p: [0.0; 2],
        },
        "OPENCV" => Distortion::BrownConrady {
            k: [lens[0], lens[1], 0.0, 0.0, 0.0, 0.0],
            p: [lens[2], lens[3]],
        },
        "FULL_OPENCV" => Distortion::BrownConrady {
            k: [lens[0], lens[1], lens[4], lens[5], lens[6], lens[7]],
            p: [lens[2], lens[3]],
        },
        "OPENCV_FISHEYE" => Distortion::KannalaBrandt {
            k: [lens[0], lens[1], lens[2], lens[3]],
        },
        _ => Distortion::None,
    };
    // A lens whose coefficients are all zero is a pinhole, and needs no undistortion.
    let straight = lens.iter().all(|&v| v == 0.0) && name != "OPENCV_FISHEYE";
    Ok(CameraModel {
        width,
        height,
        intrinsics,
        distortion: if straight { Distortion::None } else { distortion },
    })
}

fn pose(q: [f64; 4], t: [f64; 3]) -> Result<Transform<World, Camera>, String> {
    let quaternion = Quaternion::new(q[0], q[1], q[2], q[3]);
    let norm = quaternion.norm();
    if !norm.is_finite() || norm < 1e-6 || !t.iter().all(|v| v.is_finite()) {
        return Err(format!(
            "expected a pose of finite numbers and a quaternion of length 1, found {q:?} {t:?}"
        ));
    }
    Ok(Transform::<Camera, World>::new(UnitQuaternion::from_quaternion(quaternion), Vector3::from(t)).inverse())
}

impl ColmapModel {
    /// Reads `cameras`, `images` and, where there, `points3D`; binary files win over text as in COLMAP.
    pub fn read(folder: &Path) -> Result<Self, LightFieldError> {
        let binary = folder.join("cameras.bin").is_file() && folder.join("images.bin").is_file();
        let extension = if binary { "bin" } else { "txt" };
        let file = |stem: &str| folder.join(format!("{stem}.{extension}"));
        let bytes = |path: &Path| fs::read(path).map_err(LightFieldError::io(path));
        let text = |path: &Path| fs::read_to_string(path).map_err(LightFieldError::io(path));
        let (cameras, images, points) = (file("cameras"), file("images"), file("points3D"));
        let mut model = Self::default();
        let mut observed = BTreeMap::new();
        let fault = |path: &Path| {
            let path = path.to_path_buf();
            move |what: String| LightFieldError::Corrupt {
                path,
                what: format!("{what}; export the model again"),
            }
        };
        if binary {
            model.read_binary_cameras(&bytes(&cameras)?).map_err(fault(&cameras))?;
            model
                .read_binary_images(&bytes(&images)?, &mut observed)
                .map_err(fault(&images))?;
            if points.is_file() {
                model
                    .read_binary_points(&bytes(&points)?, &observed)
                    .map_err(fault(&points))?;
            }
        } else {
            model.read_text_cameras(&text(&cameras)?).map_err(fault(&cameras))?;
            model
                .read_text_images(&text(&images)?, &mut observed)
                .map_err(fault(&images))?;
            if points.is_file() {
                model.read_text_points(&text(&points)?, &observed).map_err(fault(&points))?;
            }
        }
        model.images.sort_by_key(|image| image.id);
        for image in &model.images {
            if !model.cameras.contains_key(&image.camera_id) {
                return Err(LightFieldError::corrupt(
                    &images,
                    format!(
                        "{} names camera {}, which cameras.{extension} lacks",
                        image.name, image.camera_id
                    ),
                ));
            }
        }
        Ok(model)
    }

    fn read_text_cameras(&mut self, text: &str) -> Result<(), String> {
        for line in data_lines(text) {
            let words: Vec<&str> = line.split_whitespace().collect();
            let [id, name, width, height, parameters @ ..] = &words[..] else {
                return Err(format!("expected `id MODEL width height parameters`, found `{line}`"));
            };
            let parameters: Vec<f64> = parameters.iter().map(|w| number(w)).collect::<Result<_, _>>()?;
            self.cameras
                .insert(number(id)?, camera_model(name, number(width)?, number(height)?, &parameters)?);
        }
        Ok(())
    }

    fn read_text_images(&mut self, text: &str, observed: &mut Observed) -> Result<(), String> {
        // Two lines per image; the second may be empty, so empty lines count once the first image has begun.
        let mut lines = text.lines().filter(|line| !line.trim_start().starts_with('#'));
        while let Some(line) = lines.next() {
            if line.trim().is_empty() {
                continue;
            }
            let words: Vec<&str> = line.split_whitespace().collect();
            if words.len() < 10 {
                return Err(format!("expected `id qw qx qy qz tx ty tz camera name`, found `{line}`"));
            }
            let v: Vec<f64> = words[1..8].iter().map(|w| number(w)).collect::<Result<_, _>>()?;
            let image = ColmapImage {
                id: number(words[0])?,
                camera_id: number(words[8])?,
                name: words[9..].join(" "),
                world_from_camera: pose([v[0], v[1], v[2], v[3]], [v[4], v[5], v[6]])?,
            };
            let seen: Vec<&str> = lines.next().unwrap_or("").split_whitespace().collect();
            let pixels = seen.chunks_exact(3).map(|c| {
                Ok(Pixel {
                    x: number::<f64>(c[0])? - 0.5,
                    y: number::<f64>(c[1])? - 0.5,
                })
            });
            observed.insert(image.id, pixels.collect::<Result<_, String>>()?);
            self.images.push(image);
        }
        Ok(())
    }

    fn read_text_points(&mut self, text: &str, observed: &Observed) -> Result<(), String> {
        for line in data_lines(text) {
            let words: Vec<&str> = line.split_whitespace().collect();
            if words.len() < 8 {
                return Err(format!("expected `id x y z r g b error track`, found `{line}`"));
            }
            let position = Point::new(number(words[1])?, number(words[2])?, number(words[3])?);
            let mut observations = Vec::new();
            for pair in words[8..].chunks_exact(2) {
                observations.extend(observation(observed, number(pair[0])?, number(pair[1])?));
            }
            self.points.push(ColmapPoint { position, observations });
        }
        Ok(())
    }

    fn read_binary_cameras(&mut self, bytes: &[u8]) -> Result<(), String> {
        let mut bytes = Bytes(bytes);
        for _ in 0..bytes.u64()? {
            let (id, model) = (bytes.u32()?, bytes.u32()? as i32);
            let (width, height) = (bytes.u64()? as usize, bytes.u64()? as usize);
            let &(name, _, count) = MODELS
                .iter()
                .find(|m| m.1 == model)
                .ok_or_else(|| format!("camera model number {model} is unknown here"))?;
            let parameters: Vec<f64> = (0..count).map(|_| bytes.f64()).collect::<Result<_, _>>()?;
            self.cameras.insert(id, camera_model(name, width, height, &parameters)?);
        }
        Ok(())
    }

    fn read_binary_images(&mut self, bytes: &[u8], observed: &mut Observed) -> Result<(), String> {
        let mut bytes = Bytes(bytes);
        for _ in 0..bytes.u64()? {
            let id = bytes.u32()?;
            let q = [bytes.f64()?, bytes.f64()?, bytes.f64()?, bytes.f64()?];
            let t = [bytes.f64()?, bytes.f64()?, bytes.f64()?];
            let camera_id = bytes.u32()?;
            let name = bytes.name()?;
            let count = bytes.u64()?;
            let mut pixels = Vec::new();
            for _ in 0..count {
                pixels.push(Pixel {
                    x: bytes.f64()? - 0.5,
                    y: bytes.f64()? - 0.5,
                });
                bytes.u64()?;
            }
            observed.insert(id, pixels);
            self.images.push(ColmapImage {
                id,
                name,
                camera_id,
                world_from_camera: pose(q, t)?,
            });
        }
        Ok(())
    }

    fn read_binary_points(&mut self, bytes: &[u8], observed: &Observed) -> Result<(), String> {
        let mut bytes = Bytes(bytes);
        for _ in 0..bytes.u64()? {
            bytes.u64()?;
            let position = Point::new(bytes.f64()?, bytes.f64()?, bytes.f64()?);
            let _color = bytes.take::<3>()?;
            let _error = bytes.f64()?;
            let mut observations = Vec::new();
            for _ in 0..bytes.u64()? {
                observations.extend(observation(observed, bytes.u32()?, bytes.u32()?));
            }
            self.points.push(ColmapPoint { position, observations });
        }
        Ok(())
    }

    /// Writes the model as text, every camera as a PINHOLE (its lens is not written: the pictures are undistorted).
    pub fn write_text(&self, folder: &Path) -> Result<(), LightFieldError> {
        fs::create_dir_all(folder).map_err(LightFieldError::io(folder))?;
        let mut cameras = String::from("# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[] (fx fy cx cy; pixel centres at 0.5)\n");
        for (id, camera) in &self.cameras {
            let k = &camera.intrinsics;
            writeln!(
                cameras,
                "{id} PINHOLE {} {} {} {} {} {}",
                camera.width,
                camera.height,
                k.fx,
                k.fy,
                k.cx + 0.5,
                k.cy + 0.5
            )
            .ok();
        }
        let mut seen: BTreeMap<u32, Vec<(Pixel, usize)>> = BTreeMap::new();
        let mut points = String::from("# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] (IMAGE_ID, POINT2D_IDX); mm\n");
        for (index, point) in self.points.iter().enumerate() {
            let p = point.position.coords;
            write!(points, "{} {} {} {} 128 128 128 0", index + 1, p.x, p.y, p.z).ok();
            for &(image, pixel) in &point.observations {
                let list = seen.entry(image).or_default();
                write!(points, " {image} {}", list.len()).ok();
                list.push((pixel, index + 1));
            }
            points.push('\n');
        }
        let mut images = String::from(
            "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME (camera from world, mm)\n# POINTS2D[] (X, Y, POINT3D_ID)\n",
        );
        for image in &self.images {
            let pose = image.world_from_camera.inverse();
            let (q, t) = (pose.rotation(), pose.translation());
            writeln!(
                images,
                "{} {} {} {} {} {} {} {} {} {}",
                image.id, q.w, q.i, q.j, q.k, t.x, t.y, t.z, image.camera_id, image.name
            )
            .ok();
            let line: Vec<String> = seen
                .get(&image.id)
                .into_iter()
                .flatten()
                .map(|(pixel, point)| format!("{:.4} {:.4} {point}", pixel.x + 0.5, pixel.y + 0.5))
                .collect();
            images.push_str(&line.join(" "));
            images.push('\n');
        }
        for (name, text) in [("cameras.txt", cameras), ("images.txt", images), ("points3D.txt", points)] {
            let path = folder.join(name);
            fs::write(&path, text).map_err(LightFieldError::io(&path))?;
        }
        Ok(())
    }
}

type Observed = BTreeMap<u32, Vec<Pixel>>;

fn observation(observed: &Observed, image: u32, index: u32) -> Option<(u32, Pixel)> {
    observed.get(&image)?.get(index as usize).map(|&pixel| (image, pixel))
}

fn data_lines(text: &str) -> impl Iterator<Item = &str> {
    text.lines()
        .map(str::trim)
        .filter(|line| !line.is_empty() && !line.starts_with('#'))
}

fn number<T: std::str::FromStr>(word: &str) -> Result<T, String> {
    word.parse().map_err(|_| format!("expected a number, found `{word}`"))
}

struct Bytes<'a>(&'a [u8]);

impl Bytes<'_> {
    fn take<const N: usize>(&mut self) -> Result<[u8; N], String> {
        let (head, rest) = self.0.split_first_chunk::<N>().ok_or("the file ends too early")?;
        self.0 = rest;
        Ok(*head)
    }

    fn u32(&mut self) -> Result<u32, String> {
        self.take().map(u32::from_le_bytes)
    }

    fn u64(&mut self) -> Result<u64, String> {
        self.take().map(u64::from_le_bytes)
    }

    fn f64(&mut self) -> Result<f64, String> {
        self.take().map(f64::from_le_bytes)
    }

    fn name(&mut self) -> Result<String, String> {
        let end = self.0.iter().position(|&b| b == 0).ok_or("a name without an end")?;
        let name = std::str::from_utf8(&self.0[..end])
            .map_err(|_| "a name that is not UTF-8")?
            .to_owned();
        self.0 = &self.0[end + 1..];
        Ok(name)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn model() -> ColmapModel {
        let camera = CameraModel {
            width: 320,
            height: 240,
            intrinsics: Intrinsics {
                fx: 300.25,
                fy: 299.5,
                cx: 159.125,
                cy: 119.0,
            },
            distortion: Distortion::None,
        };
        let pose = |x: f64| {
            Transform::new(
                UnitQuaternion::from_scaled_axis(Vector3::new(0.1, x, -0.2)),
                Vector3::new(x, 2.0, -3.0),
            )
        };
        ColmapModel {
            cameras: BTreeMap::from([(1, camera)]),
            images: vec![
                ColmapImage {
                    id: 1,
                    name: "000003.png".into(),
                    camera_id: 1,
                    world_from_camera: pose(0.5),
                },
                ColmapImage {
                    id: 2,
                    name: "000007.png".into(),
                    camera_id: 1,
                    world_from_camera: pose(1.5),
                },
            ],
            points: vec![
                ColmapPoint {
                    position: Point::new(1.0, 2.0, 70.0),
                    observations: vec![(2, Pixel { x: 10.0, y: 20.5 })],
                },
                ColmapPoint {
                    position: Point::new(3.0, 2.0, 70.0),
                    observations: vec![],
                },
            ],
        }
    }

    #[test]
    fn text_comes_back_as_written() {
        let folder = tempfile::tempdir().unwrap();
        model().write_text(folder.path()).unwrap();
        let back = ColmapModel::read(folder.path()).unwrap();
        assert_eq!(back.cameras, model().cameras);
        assert_eq!(back.points[0].observations, model().points[0].observations);
        for (a, b) in back.images.iter().zip(&model().images) {
            assert_eq!((a.id, &a.name), (b.id, &b.name));
            let apart = a.world_from_camera.inverse() * b.world_from_camera;
            assert!(apart.translation().norm() < 1e-12 && apart.rotation().angle() < 1e-7);
        }
    }

    #[test]
    fn camera_from_world_with_w_first_and_centres_at_a_half() {
        let folder = tempfile::tempdir().unwrap();
        model().write_text(folder.path()).unwrap();
        let cameras = fs::read_to_string(folder.path().join("cameras.txt")).unwrap();
        assert!(cameras.contains("1 PINHOLE 320 240 300.25 299.5 159.625 119.5"), "{cameras}");
        let images = fs::read_to_string(folder.path().join("images.txt")).unwrap();
        let second: Vec<f64> = images
            .lines()
            .nth(2)
            .unwrap()
            .split(' ')
            .skip(1)
            .take(7)
            .map(|w| w.parse().unwrap())
            .collect();
        let inverse = model().images[0].world_from_camera.inverse();
        assert!((second[0] - inverse.rotation().w).abs() < 1e-12 && (second[4] - inverse.translation().x).abs() < 1e-12);
        assert!(images.contains("10.5000 21.0000 1"), "{images}");
    }

    #[test]
    fn lenses_are_read_and_unknown_ones_named() {
        let opencv = camera_model("OPENCV", 10, 10, &[9.0, 8.0, 5.0, 5.0, 0.1, 0.2, 0.3, 0.4]).unwrap();
        assert_eq!(
            opencv.distortion,
            Distortion::BrownConrady {
                k: [0.1, 0.2, 0.0, 0.0, 0.0, 0.0],
                p: [0.3, 0.4]
            }
        );
        assert_eq!(opencv.intrinsics.cx, 4.5);
        let simple = camera_model("SIMPLE_RADIAL", 10, 10, &[9.0, 5.0, 5.0, 0.1]).unwrap();
        assert_eq!((simple.intrinsics.fy, simple.intrinsics.cy), (9.0, 4.5));
        assert!(camera_model("FOV", 10, 10, &[1.0; 5]).unwrap_err().contains("SIMPLE_RADIAL"));
        assert!(camera_model("PINHOLE", 10, 10, &[1.0; 3]).is_err());
    }

    #[test]
    fn binary_is_read() {
        let folder = tempfile::tempdir().unwrap();
        let mut cameras = Vec::new();
        cameras.extend(1_u64.to_le_bytes());
        cameras.extend(7_u32.to_le_bytes());
        cameras.extend(1_u32.to_le_bytes());
        cameras.extend(64_u64.to_le_bytes());
        cameras.extend(48_u64.to_le_bytes());
        for v in [50.0_f64, 51.0, 32.0, 24.0] {
            cameras.extend(v.to_le_bytes());
        }
        let mut images = Vec::new();
        images.extend(1_u64.to_le_bytes());
        images.extend(3_u32.to_le_bytes());
        for v in [1.0_f64, 0.0, 0.0, 0.0, 1.0, 2.0, 3.0] {
            images.extend(v.to_le_bytes());
        }
        images.extend(7_u32.to_le_bytes());
        images.extend(b"a b.png\0");
        images.extend(1_u64.to_le_bytes());
        for v in [4.5_f64, 5.5] {
            images.extend(v.to_le_bytes());
        }
        images.extend(9_u64.to_le_bytes());
        fs::write(folder.path().join("cameras.bin"), cameras).unwrap();
        fs::write(folder.path().join("images.bin"), &images).unwrap();
        let model = ColmapModel::read(folder.path()).unwrap();
        assert_eq!(model.images[0].name, "a b.png");
        assert!((model.images[0].world_from_camera.translation() - Vector3::new(-1.0, -2.0, -3.0)).norm() < 1e-12);
        assert_eq!(model.cameras[&7].intrinsics.cx, 31.5);
        fs::write(folder.path().join("images.bin"), &images[..images.len() - 9]).unwrap();
        assert!(
            ColmapModel::read(folder.path())
                .unwrap_err()
                .to_string()
                .contains("ends too early")
        );
    }
}
