//! Color normalization on pictures with known truth.

use endofield::frame::{Frame, FrameId};
use endofield::image::buffer::{Image, Rgb8};
use endofield::image::color::{delta_e_2000, lab_from_srgb8};
use endofield::image::pool::Pool;
use endofield::pipeline::stage::Stage as _;
use endofield::stages::color_normalization::color_file::ColorFile;
use endofield::stages::color_normalization::settings::{Method, ReferenceSource, Settings};
use endofield::stages::color_normalization::stage::ColorNormalization;
use endofield::stages::color_normalization::statistics::{self, Statistics};
use endofield::time::{Span, Timestamp};
use rand::SeedableRng as _;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution as _, Normal};

const WIDTH: usize = 480;
const HEIGHT: usize = 320;

fn inside(x: usize, y: usize) -> bool {
    (x as f64 - 240.0).hypot(y as f64 - 160.0) < 165.0
}

/// Liver, fat, a steel shaft and a specularity within a round image field.
fn scene(x: usize, y: usize) -> [f64; 3] {
    if !inside(x, y) {
        return [1.0, 2.0, 1.0];
    }
    let (u, v) = (x as f64, y as f64);
    let wave = (u / 23.0).sin() * (v / 31.0).cos() + 0.5 * (u / 7.0 + v / 9.0).sin();
    let shade = 1.0 - 0.5 * ((u - 240.0).hypot(v - 160.0) / 165.0).powi(2);
    let fat = ((u / 60.0).sin() + (v / 45.0).cos() - 0.9).clamp(0.0, 1.0);
    if (v - 250.0 + 0.3 * u).abs() < 9.0 {
        return [130.0 * shade; 3];
    }
    if (u - 200.0).hypot(v - 90.0) < 8.0 {
        return [255.0; 3];
    }
    let liver = [150.0 + 18.0 * wave, 78.0 + 14.0 * wave, 70.0 + 10.0 * wave];
    let yellow = [205.0 + 8.0 * wave, 165.0 + 10.0 * wave, 105.0 + 12.0 * wave];
    std::array::from_fn(|c| (liver[c] + fat * (yellow[c] - liver[c])) * shade)
}

fn picture(gains: [f64; 3], noise_levels: f64, seed: u64) -> Image<Rgb8> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let noise = Normal::new(0.0, noise_levels).unwrap();
    let mut image = Image::filled(WIDTH, HEIGHT, [0; 3]);
    for y in 0..HEIGHT {
        for x in 0..WIDTH {
            let color = scene(x, y);
            let lit = inside(x, y);
            let seen: [f64; 3] = std::array::from_fn(|c| color[c] * gains[c] + if lit { noise.sample(&mut random) } else { 0.0 });
            image.set(x, y, seen.map(|v| v.round().clamp(0.0, 255.0) as u8));
        }
    }
    image
}

fn run(stage: &mut ColorNormalization, images: &[Image<Rgb8>]) -> Vec<Image<Rgb8>> {
    let pool = Pool::new(3);
    images
        .iter()
        .enumerate()
        .map(|(i, image)| {
            let mut frame = Frame::new(FrameId(i as u64), Timestamp(0), Timestamp(0), pool.take_copy(image));
            frame.since_previous = Span::from_milliseconds(if i == 0 { 0.0 } else { 40.0 });
            stage.process(&mut frame).unwrap();
            Image::clone(&frame.image)
        })
        .collect()
}

fn mean_delta_e(a: &Image<Rgb8>, b: &Image<Rgb8>) -> f64 {
    let pixels = (0..WIDTH * HEIGHT).filter(|i| inside(i % WIDTH, i / WIDTH)).step_by(3);
    let all: Vec<f64> = pixels
        .map(|i| delta_e_2000(lab_from_srgb8(a.pixels()[i]), lab_from_srgb8(b.pixels()[i])))
        .collect();
    all.iter().sum::<f64>() / all.len() as f64
}

fn mean_color(image: &Image<Rgb8>) -> [f64; 3] {
    let n = image.pixels().len() as f64;
    std::array::from_fn(|c| image.pixels().iter().map(|p| f64::from(p[c])).sum::<f64>() / n)
}

/// Mean change of the mean color from frame to frame, levels.
fn flicker(images: &[Image<Rgb8>]) -> f64 {
    let means: Vec<_> = images.iter().map(mean_color).collect();
    let changes = means
        .windows(2)
        .map(|w| (0..3).map(|c| (w[1][c] - w[0][c]).abs()).sum::<f64>() / 3.0);
    changes.sum::<f64>() / (means.len() - 1) as f64
}

fn reference() -> Statistics {
    statistics::measure(&picture([1.0; 3], 0.0, 0), None, |c| c, |c| c)
        .statistics
        .unwrap()
}

#[test]
fn a_tinted_clip_comes_back_to_the_reference() {
    let truth = picture([1.0; 3], 0.0, 0);
    // The last picture has no noise: the noise alone is more than 1 ΔE.
    let noise_levels = |seed| if seed == 11 { 0.0 } else { 1.5 };
    let tinted: Vec<_> = (0..12)
        .map(|seed| picture([1.15, 1.0, 0.8], noise_levels(seed), seed))
        .collect();
    let before = mean_delta_e(&tinted[0], &truth);
    for (method, bound) in [
        (Method::Statistics, 2.0),
        (Method::Rotation, 3.5),
        (Method::Reinhard, 2.0),
        (Method::GrayWorld, 2.0),
    ] {
        let settings = Settings {
            method,
            ..Settings::default()
        }
        .with_reference(&reference());
        let mut stage = ColorNormalization::new(&settings, None).unwrap();
        let results = run(&mut stage, &tinted);
        let after = mean_delta_e(results.last().unwrap(), &truth);
        let (steadiness, flickered) = (flicker(&tinted[..11]), flicker(&results[..11]));
        eprintln!("{method:?}: mean ΔE2000 {before:.2} -> {after:.2}; flicker {steadiness:.4} -> {flickered:.4}");
        assert!(after <= bound, "{method:?}: {after}");
        // The map amplifies blue by 1/0.8, and the noise of its mean with it.
        assert!(
            flickered <= 1.1 * steadiness + 0.01,
            "{method:?}: {flickered} from {steadiness}"
        );
        for (i, (a, b)) in results
            .last()
            .unwrap()
            .pixels()
            .iter()
            .zip(tinted.last().unwrap().pixels())
            .enumerate()
        {
            assert!(inside(i % WIDTH, i / WIDTH) || a == b, "the surround changed");
        }
    }
}

#[test]
fn color_yaml_gives_the_reference_and_half_the_strength_goes_half_the_way() {
    let reference = reference();
    let text = format!("reference:\n  mean: {:?}\n", <[f64; 3]>::from(reference.mean));
    let file = ColorFile::parse(&text).unwrap();
    let tinted = [picture([1.15, 1.0, 0.8], 0.0, 0)];
    let distance = |strength: f64| {
        let settings = Settings {
            strength,
            ..Settings::default()
        };
        let mut stage = ColorNormalization::new(&settings, Some(&file)).unwrap();
        let result = run(&mut stage, &tinted);
        let mean = statistics::measure(&result[0], None, |c| c, |c| c).statistics.unwrap().mean;
        (mean - reference.mean).norm()
    };
    let (none, half, full) = (distance(0.0), distance(0.5), distance(1.0));
    assert!(full < 2.0 && (half / none - 0.5).abs() < 0.1, "{none} {half} {full}");
}

#[test]
fn without_a_reference_nothing_happens_and_a_line_says_so() {
    let mut stage = ColorNormalization::new(&Settings::default(), None).unwrap();
    assert!(stage.idle_reason().unwrap().contains("color.yaml"));
    let images = [picture([1.15, 1.0, 0.8], 1.5, 3)];
    assert_eq!(run(&mut stage, &images)[0], images[0]);
}

#[test]
fn the_clips_own_start_holds_its_color() {
    let settings = Settings {
        reference: ReferenceSource::Start,
        start_ms: 400.0,
        smoothing_ms: 400.0,
        ..Settings::default()
    };
    let mut stage = ColorNormalization::new(&settings, None).unwrap();
    assert_eq!(stage.idle_reason(), None);
    let mut images: Vec<_> = (0..12).map(|seed| picture([1.0; 3], 1.0, seed)).collect();
    images.extend((0..40).map(|seed| picture([1.1, 1.0, 0.9], 1.0, 50 + seed)));
    let results = run(&mut stage, &images);
    let truth = picture([1.0; 3], 0.0, 0);
    assert_eq!(results[5], images[5]);
    // The noise alone is 1.3 ΔE.
    let apart = (mean_delta_e(&images[51], &truth), mean_delta_e(&results[51], &truth));
    assert!(apart.1 < 2.3, "{apart:?}");
    // It comes gradually: no step larger than the tint's own over a time constant of ten frames.
    let step = (mean_color(&results[14])[2] - mean_color(&results[13])[2]).abs();
    assert!(step < 1.0, "{step}");
}

#[test]
fn a_picture_full_of_steel_freezes_the_map() {
    let settings = Settings::default().with_reference(&reference());
    let mut stage = ColorNormalization::new(&settings, None).unwrap();
    run(&mut stage, &[picture([1.15, 1.0, 0.8], 0.0, 0)]);
    let before = *stage.map();
    let mut steel = picture([1.15, 1.0, 0.8], 0.0, 0);
    for y in 0..HEIGHT {
        for x in 100..380 {
            steel.set(x, y, [138, 120, 96]);
        }
    }
    run(&mut stage, &[steel]);
    assert_eq!(*stage.map(), before);
}
