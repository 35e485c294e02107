//! The pixel kernels, each alone on one core.

use endofield::camera::undistortion;
use endofield::geometry::space::{Camera, World};
use endofield::geometry::transform::Transform;
use endofield::image::blur::{BlurScratch, box_blur, gaussian_blur};
use endofield::image::buffer::{Image, Mask, Rgb8};
use endofield::image::distance::{UNITS_PER_PX, chamfer_distance};
use endofield::image::remap::Interpolation;
use endofield::image::specularity::{self, SpecularityDetector};
use endofield::image::wide;
use endofield::localization::detail::{DetailPyramid, Usable};
use endofield::localization::image_alignment::{self, ImageAligner};
use endofield::stages::color_normalization::affine::{Affine, AffineRun};
use endofield::stages::temporal_median::guard::Guard;
use endofield::stages::temporal_median::history::History;
use endofield::stages::temporal_median::settings::{Distance, Method};
use endofield::stages::temporal_median::vector_median::Run;
use nalgebra::{Matrix3, Vector3};

use crate::measure::fastest_ms;
use crate::operation::Operation;

const ROUNDS: usize = 9;
const WINDOW: usize = 5;

/// What each costs, ms on one core.
pub fn timings(operation: &Operation) -> Vec<(String, f64)> {
    let mut all = Vec::new();
    let mut add = |name: &str, work: &mut dyn FnMut()| all.push((name.to_owned(), fastest_ms(ROUNDS, work)));
    let pictures = &operation.pictures;
    let picture = &pictures[0];
    let (width, height) = picture.size();

    let mut history = History::default();
    for picture in pictures.iter().take(WINDOW) {
        history.push(picture, 16);
    }
    let window: [_; WINDOW] = std::array::from_fn(|age| history.planes(age));
    let mut median = vec![[0_u8; 3]; width * height];
    let mut departs = vec![0_u8; width * height];
    for (name, method, distance) in [
        ("vector median of 5 (L1)", Method::Vector, Distance::L1),
        ("vector median of 5 (L2)", Method::Vector, Distance::L2),
        ("marginal median of 5", Method::Marginal, Distance::L1),
    ] {
        add(name, &mut || {
            wide::run(Run::<WINDOW> {
                window,
                start: 0,
                median: &mut median,
                departs: &mut departs,
                threshold: 12,
                method,
                distance,
            });
        });
    }
    let mut guard = Guard::default();
    add("motion guard", &mut || guard.judge(&history, WINDOW, (width, height)));
    add("split into planes", &mut || history.push(picture, 16));

    let map = Affine::new(
        Matrix3::new(0.87, 0.05, -0.02, 0.01, 1.04, 0.0, -0.03, 0.02, 1.27),
        Vector3::new(4.0, -6.0, 9.0),
    );
    add("affine color map", &mut || {
        wide::run(AffineRun {
            map,
            source: picture.pixels(),
            target: &mut median,
            field_of_view: &[],
        });
    });

    if let Some(camera) = &operation.recording.camera
        && let Ok(table) = undistortion::table(camera, &camera.pinhole())
    {
        let mut out = Image::filled(0, 0, [0; 3]);
        for (name, interpolation) in [
            ("remap, bilinear", Interpolation::Bilinear),
            ("remap, bicubic", Interpolation::Bicubic),
        ] {
            add(name, &mut || {
                let _fits = table.remap_rgb(picture, &mut out, interpolation);
            });
        }
    }

    let mut detector = SpecularityDetector::new(&specularity::Settings::default());
    let (mut specular, mut instruments) = (Mask::filled(0, 0, 0), Mask::filled(0, 0, 0));
    add("specularity detection", &mut || {
        detector.detect(picture, None, &mut specular, &mut instruments);
    });
    let mut distance = Image::filled(0, 0, 0);
    add("chamfer distance to 60 px", &mut || {
        chamfer_distance(&specular, 60 * UNITS_PER_PX, &mut distance);
    });
    let mut scratch = BlurScratch::default();
    let mut plane = Image::filled(width / 2, height / 2, 1.0_f32);
    add("box blur, 960x540 f32", &mut || box_blur(&mut plane, 12, &mut scratch));
    add("Gaussian blur, 960x540 f32", &mut || {
        gaussian_blur(&mut plane, 12.0, &mut scratch)
    });
    localization(operation, &specular, &mut add);
    all
}

fn localization(operation: &Operation, specular: &Mask, add: &mut dyn FnMut(&str, &mut dyn FnMut())) {
    let Some(view) = operation.light_field.views.first() else {
        return;
    };
    let picture: &Image<Rgb8> = &view.image;
    let mut scratch = BlurScratch::default();
    let mut pyramid = DetailPyramid::default();
    let usable = Usable {
        without: [Some(specular), None],
        ..Usable::default()
    };
    add("detail pyramid", &mut || pyramid.build(picture, &usable, &mut scratch));
    let mut aligner = ImageAligner::new(&operation.light_field, &image_alignment::Settings::default());
    let away = Transform::<Camera, Camera>::new(nalgebra::UnitQuaternion::identity(), Vector3::new(0.4, -0.3, 0.2));
    let guess: Transform<World, Camera> = view.world_from_camera * away;
    add("image alignment", &mut || {
        let _found = aligner.align(&pyramid, &view.camera, &guess, Some(&guess));
    });
}
