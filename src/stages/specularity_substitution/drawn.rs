//! What several views show at the spots of a block, and one colour from it, the darker heard rather than the brighter.

use crate::image::wide;

/// A view that may show the lamp and is this much brighter than the blend counts for half, levels: the lamp only adds light.
const BRIGHTER_HALF_LEVELS: f32 = 0.8;
/// The same for a view that is sure to show tissue: what it is brighter by is noise, and to hear only the darker would keep the noise.
const BRIGHTER_HALF_WHERE_SURE: f32 = 6.8;
/// Rounds of that.
const ROUNDS: usize = 5;
/// Views agree with the blend within this, levels, and this share of its luma.
const AGREEMENT_LEVELS: f32 = 5.0;
const AGREEMENT_SHARE: f32 = 0.05;
/// Spots blended at a time.
const LANES: usize = 8;

/// What the views say of a spot together.
#[derive(Clone, Copy, Debug)]
pub struct Blended {
    /// Levels.
    pub color: [f32; 3],
    /// 0…1.
    pub confidence: f32,
    /// What difference the views leave around the hole, levels.
    pub residual: f32,
    /// Which share of the votes shows about this colour, 0…1.
    pub agreement: f32,
    /// The loudest speaker.
    pub speaker: usize,
}

/// What every speaker shows at every spot, plane by plane, speaker by speaker.
#[derive(Debug, Default)]
pub struct Drawn {
    /// Spots, rounded up to whole lanes.
    pub pitch: usize,
    /// Levels.
    pub color: [Vec<f32>; 3],
    /// Levels.
    pub luma: Vec<f32>,
    /// 0 where nothing was drawn.
    pub weight: Vec<f32>,
    /// 0…1.
    pub confidence: Vec<f32>,
    /// What difference the view leaves around the hole, levels.
    pub residual: Vec<f32>,
    speakers: usize,
}

impl Drawn {
    /// Room for so many, nothing drawn yet.
    pub fn clear(&mut self, spots: usize, speakers: usize) {
        self.speakers = speakers;
        self.pitch = spots.next_multiple_of(LANES);
        let [r, g, b] = &mut self.color;
        for plane in [
            r,
            g,
            b,
            &mut self.luma,
            &mut self.weight,
            &mut self.confidence,
            &mut self.residual,
        ] {
            plane.clear();
            plane.resize(self.pitch * speakers, 0.0);
        }
    }

    /// Blend every one of `count` spots; `None` where nobody drew.
    pub fn blend(&self, count: usize, out: &mut Vec<Option<Blended>>) {
        wide::run(Blend { drawn: self, count, out });
    }
}

/// How much brighter than the blend a view of this confidence is where it counts for half, levels.
#[inline(always)]
fn half_levels(confidence: f32) -> f32 {
    BRIGHTER_HALF_LEVELS + (BRIGHTER_HALF_WHERE_SURE - BRIGHTER_HALF_LEVELS) * confidence * confidence
}

/// Every spot's colour from its speakers, the darker heard rather than the brighter.
struct Blend<'a> {
    drawn: &'a Drawn,
    count: usize,
    out: &'a mut Vec<Option<Blended>>,
}

impl wide::Kernel for Blend<'_> {
    #[inline(always)]
    fn run(self) {
        let Self { drawn, count, out } = self;
        for begin in (0..count).step_by(LANES) {
            let lanes = |plane: &[f32], speaker: usize| -> [f32; LANES] {
                let at = speaker * drawn.pitch + begin;
                std::array::from_fn(|lane| plane[at..at + LANES][lane])
            };
            let weights = |speaker: usize, reference: &[f32; LANES]| -> [f32; LANES] {
                let (weight, luma) = (lanes(&drawn.weight, speaker), lanes(&drawn.luma, speaker));
                let confidence = lanes(&drawn.confidence, speaker);
                std::array::from_fn(|lane| {
                    let brighter = (luma[lane] - reference[lane]).max(0.0) / half_levels(confidence[lane]);
                    weight[lane] / (1.0 + brighter * brighter)
                })
            };
            let mut reference = [f32::INFINITY; LANES];
            for _ in 0..ROUNDS {
                let (mut total, mut sum) = ([1e-20_f32; LANES], [0.0_f32; LANES]);
                for speaker in 0..drawn.speakers {
                    let (weight, luma) = (weights(speaker, &reference), lanes(&drawn.luma, speaker));
                    for lane in 0..LANES {
                        total[lane] += weight[lane];
                        sum[lane] += weight[lane] * luma[lane];
                    }
                }
                for lane in 0..LANES {
                    reference[lane] = sum[lane] / total[lane];
                }
            }
            // Red, green, blue, confidence, residual.
            let mut sums = [[0.0_f32; LANES]; 5];
            let (mut total, mut most, mut loudest) = ([0.0_f32; LANES], [0.0_f32; LANES], [0_u32; LANES]);
            let (mut heard, mut agreed) = ([0.0_f32; LANES], [0.0_f32; LANES]);
            for speaker in 0..drawn.speakers {
                let weight = weights(speaker, &reference);
                let (vote, luma) = (lanes(&drawn.weight, speaker), lanes(&drawn.luma, speaker));
                for lane in 0..LANES {
                    let near = (luma[lane] - reference[lane]).abs() < AGREEMENT_LEVELS + AGREEMENT_SHARE * reference[lane];
                    heard[lane] += vote[lane];
                    agreed[lane] += if near { vote[lane] } else { 0.0 };
                }
                let [r, g, b] = &drawn.color;
                for (sum, plane) in sums.iter_mut().zip([r, g, b, &drawn.confidence, &drawn.residual]) {
                    let values = lanes(plane, speaker);
                    for lane in 0..LANES {
                        sum[lane] += weight[lane] * values[lane];
                    }
                }
                for lane in 0..LANES {
                    total[lane] += weight[lane];
                    loudest[lane] = if weight[lane] > most[lane] {
                        speaker as u32
                    } else {
                        loudest[lane]
                    };
                    most[lane] = most[lane].max(weight[lane]);
                }
            }
            for lane in 0..LANES.min(count - begin) {
                let mean = |part: usize| sums[part][lane] / total[lane];
                out.push((total[lane] > 1e-12).then(|| Blended {
                    color: [mean(0), mean(1), mean(2)].map(|c| c.clamp(0.0, 255.0)),
                    confidence: mean(3),
                    residual: mean(4),
                    agreement: agreed[lane] / heard[lane],
                    speaker: loudest[lane] as usize,
                }));
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt as _, SeedableRng as _};

    use super::*;
    use crate::image::color::luma;

    /// The plainest possible blend of one spot.
    fn reference(drawn: &[([f32; 3], f32, f32)]) -> Option<[f32; 3]> {
        let mut reference = f32::INFINITY;
        let mut color = None;
        for _ in 0..=ROUNDS {
            let (mut sum, mut total) = ([0.0_f32; 3], 0.0);
            for (color, weight, confidence) in drawn {
                let brighter = (luma(*color) - reference).max(0.0) / half_levels(*confidence);
                let weight = weight / (1.0 + brighter * brighter);
                for (sum, channel) in sum.iter_mut().zip(color) {
                    *sum += weight * channel;
                }
                total += weight;
            }
            if total < 1e-12 {
                return None;
            }
            let mean = sum.map(|s| s / total);
            reference = luma(mean);
            color = Some(mean);
        }
        color
    }

    #[test]
    fn blending_equals_its_plain_twin() {
        let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(3);
        let (spots, speakers) = (29, 6);
        let mut drawn = Drawn::default();
        drawn.clear(spots, speakers);
        for speaker in 0..speakers {
            // Spot 4 is seen by nobody.
            for k in (0..spots).filter(|k| *k != 4) {
                let at = speaker * drawn.pitch + k;
                if random.random_bool(0.7) {
                    let color: [f32; 3] = [random.random_range(20.0..200.0), random.random_range(20.0..200.0), 60.0];
                    for (plane, channel) in drawn.color.iter_mut().zip(color) {
                        plane[at] = channel;
                    }
                    drawn.luma[at] = luma(color);
                    drawn.weight[at] = random.random_range(0.01..1.0);
                    drawn.confidence[at] = random.random_range(0.0..1.0);
                }
            }
        }
        let mut blended = Vec::new();
        drawn.blend(spots, &mut blended);
        assert_eq!(blended.len(), spots);
        for (k, blended) in blended.iter().enumerate() {
            let of = |speaker: usize| {
                let at = speaker * drawn.pitch + k;
                ([0, 1, 2].map(|c| drawn.color[c][at]), drawn.weight[at], drawn.confidence[at])
            };
            let expected = reference(&(0..speakers).map(of).collect::<Vec<_>>());
            assert_eq!(blended.is_some(), expected.is_some(), "{k}");
            for (found, expected) in blended.iter().zip(expected) {
                for (found, expected) in found.color.into_iter().zip(expected) {
                    assert!((found - expected).abs() < 0.02, "{k}: {found} for {expected}");
                }
            }
        }
        assert!(blended[4].is_none());
    }
}
