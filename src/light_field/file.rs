//! The light field on disk: a COLMAP model, and beside it what COLMAP lacks.
//!
//! `sparse/*.txt` (or `.bin`), `images/000123.png` (undistorted), `confidence/000123.png` (8-bit), `depth/000123.png` (16-bit
//! steps of `depth_step_mm`, 0 unknown), `surface.ply`, and `light_field.toml` with unit, world, recipe, time offset, lamp
//! model and, per view, exposure gain and time. A folder without `light_field.toml` is a COLMAP model made elsewhere.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use ::image::codecs::png::{CompressionType, FilterType, PngEncoder};
use ::image::{ColorType, DynamicImage, ImageEncoder as _, ImageReader};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::camera::distortion::Distortion;
use crate::camera::model::CameraModel;
use crate::geometry::mesh::Mesh;
use crate::image::buffer::{Image, Mask, Rgb8};
use crate::light_field::colmap::{ColmapImage, ColmapModel, ColmapPoint, model_folder};
use crate::light_field::error::LightFieldError;
use crate::light_field::ply::{self, PlyEncoding};
use crate::light_field::undistort::undistorted;
use crate::light_field::view::{Kind, LampShading, LightField, SparsePoint, View};
use crate::progress::Progress;
use crate::time::{Span, Timestamp};

/// The largest value of a depth file; the rest is unknown.
const DEEPEST_STEP: f32 = 65000.0;
/// Hundredths of a millimetre reach 650 mm, which is deeper than any abdomen.
const DEPTH_STEP_MM: f32 = 0.01;

#[derive(Debug, Serialize, Deserialize)]
struct Manifest {
    /// Of this file.
    format: u32,
    unit: String,
    world: String,
    recipe: String,
    time_offset_s: f64,
    /// A depth file's value times this is mm.
    depth_step_mm: f32,
    #[serde(default)]
    lamp: LampShading,
    #[serde(default)]
    views: Vec<ManifestView>,
}

#[derive(Debug, Serialize, Deserialize)]
struct ManifestView {
    frame: u32,
    image: String,
    gain: [f32; 3],
    exposed_at_s: f64,
}

/// How complete a folder was.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Origin {
    /// Written by [`save`].
    Endofield,
    /// A COLMAP model: pictures and poses; confidence, depth, surface and gains are still to be made.
    Foreign,
}

/// What [`read`] found.
#[derive(Debug)]
pub struct Loaded {
    /// The light field; of a foreign model only pictures, poses and points, confidence 255 inside the field of view.
    pub light_field: LightField,
    /// Whether anything is still to be made.
    pub origin: Origin,
}

/// Reads a light field folder or a COLMAP model; see [`crate::light_field::build::open`] for one that completes the latter.
pub fn read(folder: &Path, progress: &dyn Progress) -> Result<Loaded, LightFieldError> {
    let sparse = model_folder(folder).ok_or_else(|| LightFieldError::NotALightField(folder.to_path_buf()))?;
    let model = ColmapModel::read(&sparse)?;
    if model.images.is_empty() {
        return Err(LightFieldError::corrupt(
            &sparse,
            "expected at least one image in the model, found none",
        ));
    }
    let manifest_path = folder.join("light_field.toml");
    let manifest: Option<Manifest> = if manifest_path.is_file() {
        let text = fs::read_to_string(&manifest_path).map_err(LightFieldError::io(&manifest_path))?;
        Some(toml::from_str(&text).map_err(|e| {
            let line = 1 + e
                .span()
                .map_or(0, |span| text.get(..span.start).unwrap_or("").matches('\n').count());
            let what = format!("line {line}: {}; build the light field again", e.message().replace('\n', " "));
            LightFieldError::corrupt(&manifest_path, what)
        })?)
    } else {
        tracing::warn!(
            "{}: no light_field.toml; taken as a COLMAP model, its unit as mm",
            folder.display()
        );
        None
    };
    let pictures = [folder.join("images"), folder.to_path_buf()]
        .into_iter()
        .find(|f| f.join(&model.images[0].name).is_file());
    let pictures = pictures.unwrap_or_else(|| folder.join("images"));
    let cameras: BTreeMap<u32, (CameraModel, Arc<CameraModel>)> = model
        .cameras
        .iter()
        .map(|(&id, camera)| (id, (camera.clone(), Arc::new(camera.pinhole()))))
        .collect();
    let by_name: BTreeMap<&str, &ManifestView> = manifest
        .iter()
        .flat_map(|m| m.views.iter().map(|v| (v.image.as_str(), v)))
        .collect();
    progress.begin("reading the light field", model.images.len() as u64);
    let mut views = (model.images.par_iter().enumerate())
        .map(|(index, entry)| {
            let (lens, pinhole) = &cameras[&entry.camera_id];
            let about = by_name.get(entry.name.as_str()).copied();
            let view = read_view(folder, &pictures, entry, index, lens, pinhole, manifest.as_ref(), about)?;
            progress.advance(1);
            if progress.stopping() {
                Err(LightFieldError::Stopped)
            } else {
                Ok(view)
            }
        })
        .collect::<Result<Vec<View>, LightFieldError>>()?;
    progress.end();
    let frame_by_id: BTreeMap<u32, u32> = model.images.iter().zip(&views).map(|(i, v)| (i.id, v.frame_number)).collect();
    views.sort_by_key(|view| view.frame_number);
    let points = (model.points.into_iter())
        .map(|p| SparsePoint {
            position: p.position,
            observations: p
                .observations
                .iter()
                .filter_map(|(id, pixel)| Some((*frame_by_id.get(id)?, *pixel)))
                .collect(),
        })
        .collect();
    let surface_path = folder.join("surface.ply");
    let surface = match (&manifest, surface_path.is_file()) {
        (_, true) => ply::read(&surface_path)?,
        (None, false) => Mesh::default(),
        (Some(_), false) => {
            return Err(LightFieldError::corrupt(
                &surface_path,
                "expected the light field's surface, found no file; build the light field again",
            ));
        }
    };
    let origin = if manifest.is_some() {
        Origin::Endofield
    } else {
        Origin::Foreign
    };
    let (time_offset, shading, recipe) = match manifest {
        Some(m) => (Span::from_seconds(m.time_offset_s), m.lamp, m.recipe),
        None => (
            Span::default(),
            LampShading::default(),
            format!("COLMAP model {}", folder.display()),
        ),
    };
    Ok(Loaded {
        light_field: LightField {
            views,
            surface,
            time_offset,
            points,
            shading,
            recipe,
            kind: Kind::Survey,
        },
        origin,
    })
}

fn read_view(
    folder: &Path,
    pictures: &Path,
    entry: &ColmapImage,
    index: usize,
    lens: &CameraModel,
    pinhole: &Arc<CameraModel>,
    manifest: Option<&Manifest>,
    about: Option<&ManifestView>,
) -> Result<View, LightFieldError> {
    let path = pictures.join(&entry.name);
    let raw = rgb(&path)?;
    right_size(&path, raw.size(), lens)?;
    let (image, field) = match lens.distortion {
        Distortion::None => (raw, Image::filled(lens.width, lens.height, 255)),
        _ => undistorted(&raw, lens),
    };
    let side = |kind: &str| folder.join(kind).join(Path::new(&entry.name).with_extension("png"));
    let (confidence, depth) = match manifest {
        None => (field, Image::filled(image.width(), image.height(), 0.0)),
        Some(manifest) => {
            let path = side("confidence");
            let confidence = gray(&path)?;
            right_size(&path, confidence.size(), lens)?;
            let path = side("depth");
            let depth = depth(&path, manifest.depth_step_mm)?;
            right_size(&path, depth.size(), lens)?;
            (confidence, depth)
        }
    };
    Ok(View {
        frame_number: about.map_or_else(|| number_in(&entry.name).unwrap_or(index as u32), |v| v.frame),
        image,
        confidence,
        depth,
        camera: Arc::clone(pinhole),
        world_from_camera: entry.world_from_camera,
        gain: about.map_or([1.0; 3], |v| v.gain),
        exposed_at: Timestamp::from_seconds(about.map_or(0.0, |v| v.exposed_at_s)),
    })
}

/// Writes the folder; files that are there are replaced.
pub fn save(light_field: &LightField, folder: &Path, progress: &dyn Progress) -> Result<(), LightFieldError> {
    for part in ["images", "confidence", "depth", "sparse"] {
        let path = folder.join(part);
        fs::create_dir_all(&path).map_err(LightFieldError::io(&path))?;
    }
    let name = |view: &View| format!("{:06}.png", view.frame_number);
    let mut model = ColmapModel::default();
    let mut id_by_frame = BTreeMap::new();
    for (index, view) in light_field.views.iter().enumerate() {
        let known = model
            .cameras
            .iter()
            .find(|(_, camera)| **camera == *view.camera)
            .map(|(&id, _)| id);
        let camera_id = known.unwrap_or(model.cameras.len() as u32 + 1);
        model.cameras.entry(camera_id).or_insert_with(|| (*view.camera).clone());
        let id = index as u32 + 1;
        id_by_frame.insert(view.frame_number, id);
        model.images.push(ColmapImage {
            id,
            name: name(view),
            camera_id,
            world_from_camera: view.world_from_camera,
        });
    }
    model.points = (light_field.points.iter())
        .map(|p| ColmapPoint {
            position: p.position,
            observations: p
                .observations
                .iter()
                .filter_map(|(frame, pixel)| Some((*id_by_frame.get(frame)?, *pixel)))
                .collect(),
        })
        .collect();
    model.write_text(&folder.join("sparse"))?;
    let deepest = light_field
        .views
        .iter()
        .flat_map(|v| v.depth.pixels())
        .copied()
        .fold(0.0_f32, f32::max);
    let depth_step_mm = DEPTH_STEP_MM.max(deepest / DEEPEST_STEP);
    progress.begin("writing the light field", light_field.views.len() as u64);
    light_field.views.par_iter().try_for_each(|view| {
        let file = |part: &str| folder.join(part).join(name(view));
        write_png(&file("images"), view.image.as_bytes(), view.image.size(), ColorType::Rgb8)?;
        write_png(
            &file("confidence"),
            view.confidence.pixels(),
            view.confidence.size(),
            ColorType::L8,
        )?;
        let steps: Vec<u16> = view
            .depth
            .pixels()
            .iter()
            .map(|z| (z / depth_step_mm).round().clamp(0.0, 65535.0) as u16)
            .collect();
        write_png(
            &file("depth"),
            bytemuck::cast_slice(&steps),
            view.depth.size(),
            ColorType::L16,
        )?;
        progress.advance(1);
        if progress.stopping() {
            Err(LightFieldError::Stopped)
        } else {
            Ok(())
        }
    })?;
    progress.end();
    ply::write(
        &light_field.surface,
        &folder.join("surface.ply"),
        PlyEncoding::BinaryLittleEndian,
    )?;
    let manifest = Manifest {
        format: 1,
        unit: "mm".into(),
        world: "base".into(),
        recipe: light_field.recipe.clone(),
        time_offset_s: light_field.time_offset.seconds(),
        depth_step_mm,
        lamp: light_field.shading,
        views: (light_field.views.iter())
            .map(|v| ManifestView {
                frame: v.frame_number,
                image: name(v),
                gain: v.gain,
                exposed_at_s: v.exposed_at.seconds(),
            })
            .collect(),
    };
    let path = folder.join("light_field.toml");
    let text = toml::to_string_pretty(&manifest).map_err(|e| LightFieldError::corrupt(&path, e.to_string()))?;
    let head = "# A light field: COLMAP model in sparse/, pictures in images/, and beside them confidence/ (8 bit), depth/ (16 bit,\n\
                # steps of depth_step_mm along the optical axis, 0 unknown) and surface.ply. Lengths in mm.\n";
    fs::write(&path, format!("{head}{text}")).map_err(LightFieldError::io(&path))
}

fn write_png(path: &Path, bytes: &[u8], size: (usize, usize), color: ColorType) -> Result<(), LightFieldError> {
    let mut encoded = Vec::new();
    PngEncoder::new_with_quality(&mut encoded, CompressionType::Fast, FilterType::Up)
        .write_image(bytes, size.0 as u32, size.1 as u32, color.into())
        .map_err(|e| LightFieldError::corrupt(path, e.to_string()))?;
    fs::write(path, encoded).map_err(LightFieldError::io(path))
}

/// Writes a picture as PNG.
pub fn write_rgb(path: &Path, image: &Image<Rgb8>) -> Result<(), LightFieldError> {
    write_png(path, image.as_bytes(), image.size(), ColorType::Rgb8)
}

/// Writes a mask as PNG.
pub fn write_mask(path: &Path, mask: &Mask) -> Result<(), LightFieldError> {
    write_png(path, mask.pixels(), mask.size(), ColorType::L8)
}

fn decode(path: &Path) -> Result<DynamicImage, LightFieldError> {
    if !path.is_file() {
        return Err(LightFieldError::MissingImage {
            path: path.to_path_buf(),
        });
    }
    let reader = ImageReader::open(path)
        .and_then(ImageReader::with_guessed_format)
        .map_err(LightFieldError::io(path))?;
    reader
        .decode()
        .map_err(|e| LightFieldError::corrupt(path, format!("expected a picture, found none that can be decoded ({e})")))
}

fn rgb(path: &Path) -> Result<Image<Rgb8>, LightFieldError> {
    let decoded = decode(path)?.into_rgb8();
    let (width, height) = decoded.dimensions();
    let pixels: Vec<Rgb8> = decoded.as_raw().chunks_exact(3).map(|p| [p[0], p[1], p[2]]).collect();
    Image::from_vec(width as usize, height as usize, pixels).ok_or_else(|| LightFieldError::corrupt(path, "odd picture size"))
}

fn gray(path: &Path) -> Result<Mask, LightFieldError> {
    let decoded = decode(path)?.into_luma8();
    let (width, height) = decoded.dimensions();
    Image::from_vec(width as usize, height as usize, decoded.into_raw())
        .ok_or_else(|| LightFieldError::corrupt(path, "odd picture size"))
}

fn depth(path: &Path, step_mm: f32) -> Result<Image<f32>, LightFieldError> {
    let decoded = decode(path)?.into_luma16();
    let (width, height) = decoded.dimensions();
    let depths = decoded.as_raw().iter().map(|&v| f32::from(v) * step_mm).collect();
    Image::from_vec(width as usize, height as usize, depths).ok_or_else(|| LightFieldError::corrupt(path, "odd picture size"))
}

fn right_size(path: &Path, (width, height): (usize, usize), camera: &CameraModel) -> Result<(), LightFieldError> {
    if (width, height) == (camera.width, camera.height) {
        return Ok(());
    }
    let path: PathBuf = path.to_path_buf();
    Err(LightFieldError::WrongSize {
        path,
        expected_width: camera.width,
        expected_height: camera.height,
        width,
        height,
    })
}

/// The last run of digits in a file's name.
pub fn number_in(name: &str) -> Option<u32> {
    let stem = Path::new(name).file_stem()?.to_str()?;
    let end = stem.rfind(|c: char| c.is_ascii_digit())? + 1;
    let start = stem[..end].rfind(|c: char| !c.is_ascii_digit()).map_or(0, |i| i + 1);
    stem[start..end].parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frame_numbers_in_names() {
        assert_eq!(number_in("000123.png"), Some(123));
        assert_eq!(number_in("templeR0013.png"), Some(13));
        assert_eq!(number_in("a/b_7_left.jpg"), Some(7));
        assert_eq!(number_in("none.png"), None);
    }
}
