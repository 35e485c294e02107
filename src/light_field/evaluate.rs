//! How well the light field predicts a picture it did not see: each view rendered from the others.

use rayon::prelude::*;
use serde::Serialize;

use crate::image::buffer::{Image, Mask, Rgb8};
use crate::light_field::renderer::Renderer;
use crate::light_field::view::LightField;
use crate::progress::Progress;
use crate::quality::similarity::{SquaredError, ssim_map, texture_of};

/// One view against what the others say.
#[derive(Clone, Debug, Serialize)]
pub struct ViewScore {
    /// The frame it is.
    pub frame: u32,
    /// Over all rendered pixels, dB.
    pub psnr: f64,
    /// Over all rendered pixels, gray.
    pub ssim: f64,
    /// Over rendered pixels where the view itself shows no specularity, dB.
    pub psnr_without_specular: f64,
    /// The same, gray.
    pub ssim_without_specular: f64,
    /// Brightness fluctuations slower than 8 px taken out of both, without specular pixels, dB.
    pub texture_psnr: f64,
    /// Share of the picture that could be rendered.
    pub covered: f64,
}

/// All views.
#[derive(Clone, Debug, Serialize)]
pub struct Evaluation {
    /// Means over the views.
    pub mean: ViewScore,
    /// Each view.
    pub views: Vec<ViewScore>,
}

/// Renders each view from the others (its pose and the surface are kept, its picture is not used) and compares.
pub fn leave_one_out(light_field: &LightField, progress: &dyn Progress) -> Evaluation {
    progress.begin("leaving one out", light_field.views.len() as u64);
    let views: Vec<ViewScore> = (0..light_field.views.len())
        .into_par_iter()
        .map_init(
            || Renderer::new(light_field),
            |renderer, index| {
                let score = score(light_field, renderer, index);
                progress.advance(1);
                score
            },
        )
        .collect();
    progress.end();
    let mean = |value: fn(&ViewScore) -> f64| {
        let finite: Vec<f64> = views.iter().map(value).filter(|v| v.is_finite()).collect();
        finite.iter().sum::<f64>() / finite.len().max(1) as f64
    };
    let mean = ViewScore {
        frame: 0,
        psnr: mean(|v| v.psnr),
        ssim: mean(|v| v.ssim),
        psnr_without_specular: mean(|v| v.psnr_without_specular),
        ssim_without_specular: mean(|v| v.ssim_without_specular),
        texture_psnr: mean(|v| v.texture_psnr),
        covered: mean(|v| v.covered),
    };
    Evaluation { mean, views }
}

fn score(light_field: &LightField, renderer: &mut Renderer, index: usize) -> ViewScore {
    let view = &light_field.views[index];
    let (mut rendered, mut valid) = (Image::filled(0, 0, [0; 3]), Image::filled(0, 0, 0));
    renderer.exclude(Some(index));
    renderer.render_on_depth(
        light_field,
        &view.camera,
        &view.world_from_camera,
        &view.depth,
        &mut rendered,
        &mut valid,
    );
    renderer.exclude(None);
    // Back to this view's own exposure.
    for pixel in rendered.pixels_mut() {
        for (value, gain) in pixel.iter_mut().zip(view.gain) {
            *value = (f32::from(*value) / gain + 0.5).clamp(0.0, 255.0) as u8;
        }
    }
    // What was not rendered is taken from the view, so that windows across the border see no false edge.
    let filled = joined(&rendered, &view.image, &valid);
    let ssim = ssim_map(&filled, &view.image);
    let (mut all, mut clean, mut texture) = (SquaredError::default(), SquaredError::default(), SquaredError::default());
    let (mut similar, mut similar_clean) = ((0.0, 0.0), (0.0, 0.0));
    // Out of the view's own specularities, both pictures show the same where nothing is compared.
    let (high_a, high_b) = (texture_of(&filled, 8.0), texture_of(&view.image, 8.0));
    for i in 0..valid.pixels().len() {
        if valid.pixels()[i] == 0 {
            continue;
        }
        let (a, b) = (filled.pixels()[i].map(f32::from), view.image.pixels()[i].map(f32::from));
        all.add(a, b);
        similar = (similar.0 + ssim.pixels()[i], similar.1 + 1.0);
        if view.confidence.pixels()[i] == 255 {
            clean.add(a, b);
            texture.add(high_a.pixels()[i], high_b.pixels()[i]);
            similar_clean = (similar_clean.0 + ssim.pixels()[i], similar_clean.1 + 1.0);
        }
    }
    ViewScore {
        frame: view.frame_number,
        psnr: all.psnr(),
        ssim: similar.0 / similar.1,
        psnr_without_specular: clean.psnr(),
        ssim_without_specular: similar_clean.0 / similar_clean.1,
        texture_psnr: texture.psnr(),
        covered: all.pixels() as f64 / valid.pixels().len().max(1) as f64,
    }
}

fn joined(a: &Image<Rgb8>, b: &Image<Rgb8>, choose_a: &Mask) -> Image<Rgb8> {
    let mut out = b.clone();
    for ((out, a), &choice) in out.pixels_mut().iter_mut().zip(a.pixels()).zip(choose_a.pixels()) {
        if choice != 0 {
            *out = *a;
        }
    }
    out
}
