//! The figures by which a substitution of specularities is judged, against the exact truth of a simulated operation.
//!
//! Inside the true specular mask (instruments taken out): texture PSNR, SSIM, plain PSNR against the diffuse render, and jitter,
//! the mean absolute difference of gray between consecutive frames inside the mask over that of a ring (3–12 px) around it.
//! Of the output's own mask: recall, false touches, instrument pixels painted. Away from the mask: damage done elsewhere. The
//! untreated input is scored beside the output.

use serde::Serialize;

use crate::image::buffer::{Image, Mask, Rgb8};
use crate::quality::similarity::{SquaredError, gray_of, ssim_map, texture_of};

/// σ of the Gaussian that is taken out for the texture figure, px.
const TEXTURE_SIGMA_PX: f32 = 8.0;
/// A pixel more than this above the diffuse render must be found, levels.
const STRONG_LEVELS: u8 = 40;
/// A filled pixel farther than this from any specularity is a false touch, px.
const FALSE_TOUCH_PX: f32 = 10.0;
/// Farther than this from the mask the picture must be as it came, px.
const ELSEWHERE_PX: f32 = 12.0;
/// The ring around the mask, px.
const RING_PX: (f32, f32) = (3.0, 12.0);
/// Values of an output mask from this on say "filled".
const FILLED: u8 = 128;

/// What is true of one frame.
#[derive(Clone, Copy, Debug)]
pub struct TruthFrame<'a> {
    /// The scene without the lamp's mirror image, undistorted.
    pub diffuse: &'a Image<Rgb8>,
    /// Non-zero where there is a specularity.
    pub specular: &'a Mask,
    /// Levels above the diffuse render.
    pub strength: &'a Mask,
    /// Non-zero where an instrument is seen.
    pub instruments: Option<&'a Mask>,
}

/// What became of it.
#[derive(Clone, Copy, Debug)]
pub struct OutputFrame<'a> {
    /// The output.
    pub image: &'a Image<Rgb8>,
    /// The output's mask (values of `--mask-out`).
    pub mask: &'a Mask,
    /// The input, undistorted.
    pub input: &'a Image<Rgb8>,
}

/// Why frames could not be compared.
#[derive(Debug, thiserror::Error)]
#[error(
    "expected pictures of {expected_width}×{expected_height} as the truth's, found {width}×{height} ({what}); compare undistorted output of the same size"
)]
pub struct SizeMismatch {
    /// Which picture.
    pub what: &'static str,
    /// Of the truth.
    pub expected_width: usize,
    /// Of the truth.
    pub expected_height: usize,
    /// Found.
    pub width: usize,
    /// Found.
    pub height: usize,
}

/// Figures inside the true mask.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct MaskScores {
    /// dB.
    pub texture_psnr: f64,
    /// 0–1.
    pub ssim: f64,
    /// dB.
    pub plain_psnr: f64,
    /// Ratio; 1 = as restless as its surroundings.
    pub jitter: f64,
}

/// All figures.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct Summary {
    /// Frames compared.
    pub frames: u64,
    /// The input, untreated.
    pub as_it_is: MaskScores,
    /// The output.
    pub output: MaskScores,
    /// Share of strong specular pixels that were filled.
    pub recall: f64,
    /// Share of the picture filled farther than 10 px from any specularity.
    pub false_touches: f64,
    /// PSNR against the input more than 12 px away from the mask, dB.
    pub elsewhere_psnr: f64,
    /// Filled instrument pixels.
    pub instrument_painted: u64,
    /// Share of the filled pixels that came from the light field (255).
    pub from_light_field: f64,
}

#[derive(Clone, Debug, Default)]
struct Scores {
    texture: SquaredError,
    plain: SquaredError,
    ssim: f64,
    inside: (f64, u64),
    ring: (f64, u64),
    previous_gray: Vec<u8>,
}

/// Gathers figures frame by frame.
#[derive(Clone, Debug, Default)]
pub struct Figures {
    frames: u64,
    as_it_is: Scores,
    output: Scores,
    previous_zone: Vec<Zone>,
    strong: (u64, u64),
    false_touches: u64,
    pixels: u64,
    elsewhere: SquaredError,
    painted: u64,
    filled: (u64, u64),
}

#[derive(Clone, Copy, Debug, Default, PartialEq)]
enum Zone {
    Mask,
    Ring,
    #[default]
    Other,
}

impl Figures {
    /// Nothing yet.
    pub fn new() -> Self {
        Self::default()
    }

    /// One more frame; frames must come in their order, because jitter compares neighbours.
    pub fn add(&mut self, truth: &TruthFrame<'_>, output: &OutputFrame<'_>) -> Result<(), SizeMismatch> {
        let size = truth.diffuse.size();
        let sizes = [
            ("mask of the truth", truth.specular.size()),
            ("strength", truth.strength.size()),
            ("instruments", truth.instruments.map_or(size, Image::size)),
            ("output", output.image.size()),
            ("mask of the output", output.mask.size()),
            ("input", output.input.size()),
        ];
        if let Some(&(what, (width, height))) = sizes.iter().find(|s| s.1 != size) {
            return Err(SizeMismatch {
                what,
                expected_width: size.0,
                expected_height: size.1,
                width,
                height,
            });
        }
        let count = size.0 * size.1;
        let instrument: Vec<bool> = truth
            .instruments
            .map_or_else(|| vec![false; count], |m| m.pixels().iter().map(|&v| v != 0).collect());
        let specular: Vec<bool> = (0..count)
            .map(|i| truth.specular.pixels()[i] != 0 && !instrument[i])
            .collect();
        let from_mask = distance(&specular, size.0, size.1);
        let from_instrument = distance(&instrument, size.0, size.1);
        let zones: Vec<Zone> = (0..count)
            .map(|i| {
                if specular[i] {
                    Zone::Mask
                } else if from_mask[i] > RING_PX.0 && from_mask[i] <= RING_PX.1 && from_instrument[i] > RING_PX.0 {
                    Zone::Ring
                } else {
                    Zone::Other
                }
            })
            .collect();
        let texture = texture_of(truth.diffuse, TEXTURE_SIGMA_PX);
        self.as_it_is
            .add(output.input, truth.diffuse, &texture, &zones, &self.previous_zone);
        self.output
            .add(output.image, truth.diffuse, &texture, &zones, &self.previous_zone);
        for i in 0..count {
            let filled = output.mask.pixels()[i] >= FILLED;
            self.filled.0 += u64::from(filled);
            self.filled.1 += u64::from(output.mask.pixels()[i] == 255);
            if truth.strength.pixels()[i] > STRONG_LEVELS && !instrument[i] {
                self.strong.0 += 1;
                self.strong.1 += u64::from(filled);
            }
            self.false_touches += u64::from(filled && from_mask[i] > FALSE_TOUCH_PX && !instrument[i]);
            self.painted += u64::from(filled && instrument[i]);
            if from_mask[i] > ELSEWHERE_PX && from_instrument[i] > ELSEWHERE_PX {
                self.elsewhere.add(
                    output.image.pixels()[i].map(f32::from),
                    output.input.pixels()[i].map(f32::from),
                );
            }
        }
        self.pixels += count as u64;
        self.previous_zone = zones;
        self.frames += 1;
        Ok(())
    }

    /// The figures of all frames so far; NaN where there was nothing to compare.
    pub fn summary(&self) -> Summary {
        let share = |part: u64, all: u64| part as f64 / all as f64;
        Summary {
            frames: self.frames,
            as_it_is: self.as_it_is.result(),
            output: self.output.result(),
            recall: share(self.strong.1, self.strong.0),
            false_touches: share(self.false_touches, self.pixels),
            elsewhere_psnr: self.elsewhere.psnr(),
            instrument_painted: self.painted,
            from_light_field: share(self.filled.1, self.filled.0),
        }
    }
}

impl Scores {
    fn add(
        &mut self,
        image: &Image<Rgb8>,
        truth: &Image<Rgb8>,
        truth_texture: &Image<[f32; 3]>,
        zones: &[Zone],
        previous: &[Zone],
    ) {
        let texture = texture_of(image, TEXTURE_SIGMA_PX);
        let ssim = ssim_map(image, truth);
        let gray: Vec<u8> = image.pixels().iter().map(|&p| gray_of(p)).collect();
        for (i, &zone) in zones.iter().enumerate() {
            if zone == Zone::Mask {
                self.texture.add(texture.pixels()[i], truth_texture.pixels()[i]);
                self.plain
                    .add(image.pixels()[i].map(f32::from), truth.pixels()[i].map(f32::from));
                self.ssim += ssim.pixels()[i];
            }
            if previous.get(i) == Some(&zone) && self.previous_gray.len() == gray.len() {
                let change = f64::from(gray[i].abs_diff(self.previous_gray[i]));
                let sum = match zone {
                    Zone::Mask => &mut self.inside,
                    Zone::Ring => &mut self.ring,
                    Zone::Other => continue,
                };
                *sum = (sum.0 + change, sum.1 + 1);
            }
        }
        self.previous_gray = gray;
    }

    fn result(&self) -> MaskScores {
        MaskScores {
            texture_psnr: self.texture.psnr(),
            ssim: self.ssim / self.plain.pixels() as f64,
            plain_psnr: self.plain.psnr(),
            jitter: (self.inside.0 / self.inside.1 as f64) / (self.ring.0 / self.ring.1 as f64),
        }
    }
}

/// Euclidean distance of each pixel to the nearest marked one, px; huge when none is marked (Felzenszwalb and Huttenlocher,
/// "Distance Transforms of Sampled Functions", 2012, doi:10.4086/toc.2012.v008a019: lower envelope of parabolas, per axis).
fn distance(marked: &[bool], width: usize, height: usize) -> Vec<f32> {
    const FAR: f64 = 1e12;
    let mut squared: Vec<f64> = marked.iter().map(|&m| if m { 0.0 } else { FAR }).collect();
    let mut line = Vec::new();
    let mut result = Vec::new();
    for x in 0..width {
        line.clear();
        line.extend((0..height).map(|y| squared[y * width + x]));
        envelope(&line, &mut result);
        for (y, &v) in result.iter().enumerate() {
            squared[y * width + x] = v;
        }
    }
    for row in squared.chunks_exact_mut(width.max(1)) {
        line.clear();
        line.extend_from_slice(row);
        envelope(&line, &mut result);
        row.copy_from_slice(&result);
    }
    squared.iter().map(|v| v.min(FAR).sqrt() as f32).collect()
}

fn envelope(heights: &[f64], out: &mut Vec<f64>) {
    let mut parabolas: Vec<(usize, f64)> = Vec::with_capacity(heights.len());
    for (q, &h) in heights.iter().enumerate() {
        let mut start = f64::NEG_INFINITY;
        while let Some(&(v, from)) = parabolas.last() {
            let (q2, v2) = ((q * q) as f64, (v * v) as f64);
            start = ((h + q2) - (heights[v] + v2)) / (2.0 * (q - v) as f64);
            if start > from {
                break;
            }
            parabolas.pop();
            start = f64::NEG_INFINITY;
        }
        parabolas.push((q, start));
    }
    out.clear();
    let mut current = 0;
    for q in 0..heights.len() {
        while current + 1 < parabolas.len() && parabolas[current + 1].1 < q as f64 {
            current += 1;
        }
        let v = parabolas[current].0;
        out.push((q.abs_diff(v) as f64).powi(2) + heights[v]);
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt as _, SeedableRng as _};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    #[test]
    fn distances_agree_with_the_plain_ones() {
        let mut random = ChaCha8Rng::seed_from_u64(2);
        for _ in 0..10 {
            let (width, height) = (17, 11);
            let marked: Vec<bool> = (0..width * height).map(|_| random.random_range(0.0..1.0) < 0.04).collect();
            let found = distance(&marked, width, height);
            for y in 0..height {
                for x in 0..width {
                    let nearest = (0..width * height)
                        .filter(|&i| marked[i])
                        .map(|i| ((i % width) as f64 - x as f64).hypot((i / width) as f64 - y as f64))
                        .fold(1e6, f64::min);
                    assert!((f64::from(found[y * width + x]) - nearest).abs() < 1e-4 * nearest.max(1.0));
                }
            }
        }
    }

    struct Case {
        diffuse: Image<Rgb8>,
        specular: Mask,
        strength: Mask,
        instruments: Mask,
        input: Image<Rgb8>,
        output: Image<Rgb8>,
        mask: Mask,
    }

    /// 80×60, gray 100; a specularity of 10×10 at (20, 20), 60 levels strong; an instrument column at x ≥ 70.
    fn case() -> Case {
        let mut case = Case {
            diffuse: Image::filled(80, 60, [100; 3]),
            specular: Image::filled(80, 60, 0),
            strength: Image::filled(80, 60, 0),
            instruments: Image::filled(80, 60, 0),
            input: Image::filled(80, 60, [100; 3]),
            output: Image::filled(80, 60, [100; 3]),
            mask: Image::filled(80, 60, 0),
        };
        for y in 0..60 {
            for x in 70..80 {
                case.instruments.set(x, y, 255);
            }
        }
        for y in 20..30 {
            for x in 20..30 {
                case.specular.set(x, y, 255);
                case.strength.set(x, y, 60);
                case.input.set(x, y, [160; 3]);
                case.output.set(x, y, [103; 3]);
                case.mask.set(x, y, 255);
            }
        }
        case
    }

    fn figures(case: &Case, frames: usize) -> Summary {
        let mut figures = Figures::new();
        for _ in 0..frames {
            let truth = TruthFrame {
                diffuse: &case.diffuse,
                specular: &case.specular,
                strength: &case.strength,
                instruments: Some(&case.instruments),
            };
            figures
                .add(
                    &truth,
                    &OutputFrame {
                        image: &case.output,
                        mask: &case.mask,
                        input: &case.input,
                    },
                )
                .unwrap();
        }
        figures.summary()
    }

    #[test]
    fn plain_psnr_recall_and_touches_by_hand() {
        let mut case = case();
        // Half of the specularity's rows are not filled; 5 pixels far away are; 3 instrument pixels are.
        for y in 25..30 {
            for x in 20..30 {
                case.mask.set(x, y, 64);
            }
        }
        for x in 50..55 {
            case.mask.set(x, 50, 128);
        }
        for x in 70..73 {
            case.mask.set(x, 5, 255);
        }
        let found = figures(&case, 1);
        assert!((found.output.plain_psnr - 10.0 * (65025.0_f64 / 9.0).log10()).abs() < 1e-9);
        assert!((found.as_it_is.plain_psnr - 10.0 * (65025.0_f64 / 3600.0).log10()).abs() < 1e-9);
        assert!((found.recall - 0.5).abs() < 1e-12);
        assert!((found.false_touches - 5.0 / 4800.0).abs() < 1e-12);
        assert_eq!(found.instrument_painted, 3);
        assert!((found.from_light_field - 53.0 / 58.0).abs() < 1e-12);
        assert!(found.elsewhere_psnr > 160.0);
        assert!(found.output.texture_psnr > found.as_it_is.texture_psnr + 20.0);
        assert!(found.output.ssim > 0.9 && found.as_it_is.ssim < found.output.ssim);
    }

    #[test]
    fn damage_elsewhere_counts_only_beyond_twelve_pixels() {
        let mut case = case();
        case.output.set(36, 25, [90; 3]);
        assert!(figures(&case, 1).elsewhere_psnr > 160.0);
        case.output.set(50, 25, [90; 3]);
        let far = (0..60)
            .flat_map(|y| (0..80).map(move |x| (x as f64, y as f64)))
            .filter(|&(x, y)| {
                let (dx, dy) = ((20.0 - x).max(x - 29.0).max(0.0), (20.0 - y).max(y - 29.0).max(0.0));
                dx.hypot(dy) > 12.0 && 70.0 - x > 12.0
            })
            .count();
        let expected = 10.0 * (65025.0 * far as f64 / 100.0).log10();
        assert!((figures(&case, 1).elsewhere_psnr - expected).abs() < 1e-6);
    }

    #[test]
    fn jitter_is_the_ratio_of_changes() {
        let first = case();
        let mut second = case();
        for (i, pixel) in second.output.pixels_mut().iter_mut().enumerate() {
            // 4 levels inside the specularity, 2 elsewhere.
            let step = if first.specular.pixels()[i] != 0 { 4 } else { 2 };
            *pixel = pixel.map(|v| v + step);
        }
        let mut figures = Figures::new();
        for c in [&first, &second] {
            let truth = TruthFrame {
                diffuse: &c.diffuse,
                specular: &c.specular,
                strength: &c.strength,
                instruments: None,
            };
            figures
                .add(
                    &truth,
                    &OutputFrame {
                        image: &c.output,
                        mask: &c.mask,
                        input: &c.input,
                    },
                )
                .unwrap();
        }
        assert!((figures.summary().output.jitter - 2.0).abs() < 1e-12);
    }

    #[test]
    fn another_size_is_an_error() {
        let case = case();
        let small = Image::filled(8, 8, [0; 3]);
        let truth = TruthFrame {
            diffuse: &case.diffuse,
            specular: &case.specular,
            strength: &case.strength,
            instruments: None,
        };
        let error = Figures::new()
            .add(
                &truth,
                &OutputFrame {
                    image: &small,
                    mask: &case.mask,
                    input: &case.input,
                },
            )
            .unwrap_err();
        assert!(error.to_string().contains("80×60") && error.to_string().contains("8×8"));
    }
}
