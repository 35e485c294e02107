//! The temporal median on clips with known truth: particles go, what moves stays.

use endofield::frame::{Frame, FrameId};
use endofield::image::buffer::{Image, Rgb8};
use endofield::image::pool::Pool;
use endofield::pipeline::stage::Stage as _;
use endofield::stages::temporal_median::settings::{Method, Settings};
use endofield::stages::temporal_median::stage::TemporalMedian;
use endofield::time::{Span, Timestamp};
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution as _, Normal};

const WIDTH: usize = 400;
const HEIGHT: usize = 304;
const PERIOD_MS: f64 = 40.0;
const NOISE_LEVELS: f64 = 2.5;

fn hash(x: i64, y: i64) -> f64 {
    let mut h = (x.wrapping_mul(0x9E37_79B9_7F4A_7C15u64 as i64) ^ y.wrapping_mul(0xC2B2_AE3D_27D4_EB4Fu64 as i64)) as u64;
    h ^= h >> 29;
    h = h.wrapping_mul(0xBF58_476D_1CE4_E5B9);
    h ^= h >> 32;
    (h & 0xffff) as f64 / 65535.0 - 0.5
}

fn value_noise(x: f64, y: f64) -> f64 {
    let (ix, iy) = (x.floor(), y.floor());
    let s = |t: f64| t * t * (3.0 - 2.0 * t);
    let (u, v) = (s(x - ix), s(y - iy));
    let at = |dx: i64, dy: i64| hash(ix as i64 + dx, iy as i64 + dy);
    let top = at(0, 0) + u * (at(1, 0) - at(0, 0));
    let bottom = at(0, 1) + u * (at(1, 1) - at(0, 1));
    top + v * (bottom - top)
}

/// Tissue-like texture at any place of the plane.
fn tissue(x: f64, y: f64) -> [f64; 3] {
    let coarse = 70.0 * value_noise(x / 61.0, y / 57.0);
    let middle = 40.0 * value_noise(x / 17.0 + 9.0, y / 15.0);
    let fine = 22.0 * value_noise(x / 4.0, y / 4.5 + 40.0);
    let vessel = if (y - 150.0 - 40.0 * (x / 70.0).sin()).abs() < 3.0 {
        -35.0
    } else {
        0.0
    };
    let light = coarse + middle + fine;
    [150.0 + light, 90.0 + 0.7 * light + vessel, 80.0 + 0.6 * light + vessel]
}

/// What the camera should have seen, and what it saw.
struct Clip {
    clean: Vec<Image<Rgb8>>,
    seen: Vec<Image<Rgb8>>,
    /// Per frame and pixel: covered by a particle.
    covered: Vec<Vec<bool>>,
}

fn to_u8(color: [f64; 3]) -> Rgb8 {
    color.map(|v| v.round().clamp(0.0, 255.0) as u8)
}

fn clip(frames: usize, seed: u64, particles_per_frame: f64, scene: impl Fn(usize, f64, f64) -> [f64; 3]) -> Clip {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let noise = Normal::new(0.0, NOISE_LEVELS).unwrap();
    let mut covered = vec![vec![false; WIDTH * HEIGHT]; frames];
    let mut colors: Vec<Vec<Option<[f64; 3]>>> = vec![vec![None; WIDTH * HEIGHT]; frames];
    for _ in 0..(particles_per_frame * frames as f64) as usize {
        let life = random.random_range(1..=3);
        let first = random.random_range(0..frames);
        let radius = random.random_range(1.0..7.5);
        let (x0, y0) = (
            random.random_range(0.0..WIDTH as f64),
            random.random_range(0.0..HEIGHT as f64),
        );
        let speed: f64 = random.random_range(8.0..25.0);
        let angle: f64 = random.random_range(0.0..std::f64::consts::TAU);
        let color = if random.random_bool(0.6) {
            [235.0, 225.0, 215.0]
        } else {
            [30.0, 20.0, 20.0]
        };
        for t in first..(first + life).min(frames) {
            let step = (t - first) as f64 * speed;
            let (cx, cy) = (x0 + step * angle.cos(), y0 + step * angle.sin());
            for y in 0..HEIGHT {
                if (y as f64 - cy).abs() > radius {
                    continue;
                }
                for x in 0..WIDTH {
                    if (x as f64 - cx).hypot(y as f64 - cy) <= radius {
                        covered[t][y * WIDTH + x] = true;
                        colors[t][y * WIDTH + x] = Some(color);
                    }
                }
            }
        }
    }
    let (mut clean, mut seen) = (Vec::new(), Vec::new());
    for t in 0..frames {
        let mut truth = Image::filled(WIDTH, HEIGHT, [0; 3]);
        let mut noisy = Image::filled(WIDTH, HEIGHT, [0; 3]);
        for y in 0..HEIGHT {
            for x in 0..WIDTH {
                let color = scene(t, x as f64, y as f64);
                truth.set(x, y, to_u8(color));
                let shown = colors[t][y * WIDTH + x].unwrap_or(color);
                noisy.set(x, y, to_u8(shown.map(|v| v + noise.sample(&mut random))));
            }
        }
        clean.push(truth);
        seen.push(noisy);
    }
    Clip { clean, seen, covered }
}

fn run(settings: &Settings, seen: &[Image<Rgb8>]) -> Vec<Image<Rgb8>> {
    let mut stage = TemporalMedian::new(settings).unwrap();
    let pool = Pool::new(4);
    seen.iter()
        .enumerate()
        .map(|(i, image)| {
            let at = Timestamp::from_seconds(i as f64 * PERIOD_MS * 1e-3);
            let mut frame = Frame::new(FrameId(i as u64), at, at, pool.take_copy(image));
            frame.since_previous = if i == 0 { Span(0) } else { Span::from_milliseconds(PERIOD_MS) };
            stage.process(&mut frame).unwrap();
            assert_eq!(frame.exposed_at, at);
            assert!(!frame.scene_cut, "frame {i} taken for a scene cut");
            Image::clone(&frame.image)
        })
        .collect()
}

fn psnr(a: &Image<Rgb8>, b: &Image<Rgb8>) -> f64 {
    let sum: f64 = a
        .as_bytes()
        .iter()
        .zip(b.as_bytes())
        .map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2))
        .sum();
    10.0 * (255.0_f64.powi(2) * a.as_bytes().len() as f64 / sum.max(1e-9)).log10()
}

/// Smallest and mean gain in PSNR over the frames, dB.
fn gains(clip: &Clip, filtered: &[Image<Rgb8>]) -> (f64, f64) {
    let gains: Vec<f64> = (0..filtered.len())
        .map(|t| psnr(&filtered[t], &clip.clean[t]) - psnr(&clip.seen[t], &clip.clean[t]))
        .collect();
    (
        gains.iter().copied().fold(f64::INFINITY, f64::min),
        gains.iter().sum::<f64>() / gains.len() as f64,
    )
}

/// Share of the particle pixels that come back within 4 levels: of all, and of those a window of five can see behind.
fn restored(clip: &Clip, filtered: &[Image<Rgb8>], inside: impl Fn(usize, usize) -> bool) -> (f64, f64) {
    let (mut all, mut all_good, mut fair, mut fair_good) = (0, 0, 0, 0);
    for t in 0..filtered.len() {
        for i in 0..WIDTH * HEIGHT {
            if !clip.covered[t][i] || !inside(i % WIDTH, i / WIDTH) {
                continue;
            }
            let (a, b) = (filtered[t].pixels()[i], clip.clean[t].pixels()[i]);
            let apart = (0..3).map(|c| f64::from(a[c].abs_diff(b[c]))).sum::<f64>() / 3.0;
            let window = &clip.covered[t.saturating_sub(4)..=t];
            let possible = t >= 4 && window.iter().filter(|frame| frame[i]).count() <= 2;
            let good = apart <= 4.0;
            all += 1;
            all_good += usize::from(good);
            fair += usize::from(possible);
            fair_good += usize::from(possible && good);
        }
    }
    (all_good as f64 / all.max(1) as f64, fair_good as f64 / fair.max(1) as f64)
}

fn report(name: &str, clip: &Clip, filtered: &[Image<Rgb8>]) -> (f64, f64) {
    let (worst, mean) = gains(clip, filtered);
    let (all, fair) = restored(clip, filtered, |_, _| true);
    eprintln!(
        "{name}: PSNR gain worst {worst:+.2} mean {mean:+.2} dB; particle pixels restored {all:.4}, of the possible {fair:.4}"
    );
    (worst, fair)
}

#[test]
fn particles_over_still_tissue_go() {
    let clip = clip(20, 1, 6.0, |_, x, y| tissue(x, y));
    for method in [Method::Vector, Method::Marginal] {
        let filtered = run(
            &Settings {
                method,
                ..Settings::default()
            },
            &clip.seen,
        );
        let (worst, fair) = report(&format!("still, {method:?}"), &clip, &filtered);
        // Only the first frame, before which there is nothing, is left as it came.
        let (all, _) = restored(&clip, &filtered, |_, _| true);
        assert!(worst > -0.01);
        assert!(fair >= 0.97 && all > 0.9, "{fair} {all}");
    }
}

#[test]
fn noise_alone_becomes_less() {
    let clip = clip(12, 2, 0.0, |_, x, y| tissue(x, y));
    let filtered = run(&Settings::default(), &clip.seen);
    let (worst, mean) = gains(&clip, &filtered);
    eprintln!("noise: worst {worst:+.2} mean {mean:+.2} dB");
    // Five vectors: about 0.55 of the variance once the window is full, in most blocks.
    assert!(worst > -0.01 && mean > 1.2);
}

#[test]
fn nothing_that_moves_gets_worse() {
    type Scene = fn(usize, f64, f64) -> [f64; 3];
    let scenes: [(&str, Scene); 7] = [
        ("shift 3 px", |t, x, y| tissue(x + 3.0 * t as f64, y + 1.3 * t as f64)),
        ("shift 12 px", |t, x, y| tissue(x + 12.0 * t as f64, y - 5.0 * t as f64)),
        ("shift 0.7 px", |t, x, y| tissue(x + 0.7 * t as f64, y)),
        ("shift 0.25 px", |t, x, y| tissue(x, y + 0.25 * t as f64)),
        ("breathing", |t, x, y| tissue(x, y + 6.0 * (t as f64 * 0.05).sin())),
        ("zoom 1 %", |t, x, y| {
            let scale = 1.01_f64.powi(t as i32);
            tissue(200.0 + (x - 200.0) / scale, 150.0 + (y - 150.0) / scale)
        }),
        ("heartbeat", |t, x, y| {
            let lift = 2.5 * (t as f64 * 0.9).sin() * (-((x - 120.0).powi(2) + (y - 120.0).powi(2)) / 8000.0).exp();
            tissue(x + lift, y + 0.6 * lift)
        }),
    ];
    for (index, (name, scene)) in scenes.into_iter().enumerate() {
        for particles in [0.0, 4.0] {
            let clip = clip(14, 10 + index as u64, particles, scene);
            let filtered = run(&Settings::default(), &clip.seen);
            let (worst, _) = report(&format!("{name}, {particles} particles"), &clip, &filtered);
            assert!(worst > -0.07, "{name}: a frame lost {worst:.2} dB");
        }
    }
}

/// A steel shaft with a jaw that crosses the picture, and whether a place is on it.
fn instrument(t: usize, x: f64, y: f64, speed: f64) -> Option<[f64; 3]> {
    let tip = -40.0 + speed * t as f64;
    let across = y - 140.0 - 0.2 * (x - tip);
    let jaw = (tip - x).clamp(0.0, 30.0) / 30.0 * 14.0;
    if x < tip && across.abs() < 4.0 + jaw {
        let shine = 60.0 * (-(across / 5.0).powi(2)).exp();
        return Some([120.0 + shine, 124.0 + shine, 128.0 + shine]);
    }
    None
}

#[test]
fn an_instrument_leaves_no_ghost_and_particles_still_go_elsewhere() {
    for speed in [1.0, 3.0, 9.0, 25.0] {
        let scene =
            |t: usize, x: f64, y: f64| instrument(t + (60.0 / speed) as usize, x, y, speed).unwrap_or_else(|| tissue(x, y));
        let clip = clip(16, 31, 5.0, scene);
        let filtered = run(&Settings::default(), &clip.seen);
        let (worst, fair) = report(&format!("instrument {speed} px"), &clip, &filtered);
        assert!(worst > -0.05, "speed {speed}: a frame lost {worst:.2} dB");
        // Away from the instrument's track; beside it the guard rather leaves a particle than makes a ghost.
        let (_, away) = restored(&clip, &filtered, |_, y| !(80..260).contains(&y));
        eprintln!("instrument {speed} px: of the possible {fair:.4}, away from it {away:.4}");
        assert!(away > 0.93, "speed {speed}: only {away:.3} of the particles went");
        // Ghost: pixels that the instrument covered lately or covers now, and no particle did.
        let (mut ghosts, mut counted) = (0, 0);
        for t in 5..filtered.len() {
            for i in 0..WIDTH * HEIGHT {
                let touched = (t - 4..=t).any(|s| clip.clean[s].pixels()[i] != clip.clean[t].pixels()[i]);
                if !touched || (t - 4..=t).any(|s| clip.covered[s][i]) {
                    continue;
                }
                let (a, b) = (filtered[t].pixels()[i], clip.seen[t].pixels()[i]);
                counted += 1;
                ghosts += usize::from((0..3).any(|c| a[c].abs_diff(b[c]) > 25));
            }
        }
        let share = ghosts as f64 / f64::from(counted.max(1));
        eprintln!("instrument {speed} px: ghost pixels {ghosts} of {counted} touched, {share:.4}");
        assert!(share < 0.01, "speed {speed}: {share:.4} of the touched pixels show a ghost");
    }
}

#[test]
fn a_cut_and_a_gap_forget_the_past() {
    let mut stage = TemporalMedian::new(&Settings::default()).unwrap();
    let pool = Pool::new(4);
    let mut bright = Image::filled(WIDTH, HEIGHT, [0; 3]);
    let mut dark = bright.clone();
    for y in 0..HEIGHT {
        for x in 0..WIDTH {
            bright.set(x, y, to_u8(tissue(x as f64, y as f64)));
            dark.set(x, y, to_u8(tissue(y as f64 + 900.0, x as f64).map(|v| v * 0.35)));
        }
    }
    for (i, (image, cut)) in [
        (&bright, false),
        (&bright, false),
        (&bright, false),
        (&dark, true),
        (&dark, false),
    ]
    .into_iter()
    .enumerate()
    {
        let mut frame = Frame::new(FrameId(i as u64), Timestamp(0), Timestamp(0), pool.take_copy(image));
        frame.since_previous = Span::from_milliseconds(PERIOD_MS);
        stage.process(&mut frame).unwrap();
        assert_eq!(frame.scene_cut, cut, "frame {i}");
        assert_eq!(frame.image.pixels(), image.pixels(), "frame {i}");
    }
}
