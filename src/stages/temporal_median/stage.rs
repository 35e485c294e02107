//! The temporal median as a stage of the line.

use rayon::iter::{IndexedParallelIterator as _, ParallelIterator as _};
use rayon::slice::ParallelSliceMut as _;

use crate::frame::{Frame, FrameId};
use crate::image::buffer::{Image, Rgb8};
use crate::image::wide;
use crate::pipeline::stage::{Stage, StageError};
use crate::stages::scene_cut::SceneCut;
use crate::stages::temporal_median::guard::{self, Guard};
use crate::stages::temporal_median::history::{History, TILE};
use crate::stages::temporal_median::motion::{BLOCK, Motion};
use crate::stages::temporal_median::particles::{Evidence, Particles, Side};
use crate::stages::temporal_median::settings::{Settings, SettingsError};
use crate::stages::temporal_median::vector_median::{Colors, Run, Wide};

/// The median of a tile costs the same however much of it is asked for.
const BLOCKS_PER_TILE: usize = TILE / BLOCK;
/// A gap of more periods than this makes the history worthless.
const MAX_GAP_PERIODS: f64 = 2.6;
/// Standard deviation of one channel's noise over that of the gray, (1² + 2² + 1²) / 4² inverted and rooted.
const CHANNEL_OVER_GRAY: f32 = 1.633;
/// Departures from the median below this many standard deviations are noise.
const DEPARTURE_SIGMAS: f32 = 4.5;
/// With only one older frame there is no median yet: its noise is that of a frame, and nothing confirms it.
const TWO_FRAMES_CAUTION: f32 = 1.8;

/// Takes away what is in the picture only for a moment.
#[derive(Debug)]
pub struct TemporalMedian {
    settings: Settings,
    history: History,
    guard: Guard,
    particles: Particles,
    scene_cut: SceneCut,
    output: Image<Rgb8>,
    /// 255 where the newest frame departs from the median; 0 in moving blocks.
    departs: Vec<u8>,
    /// Per block: whether some pixel departs.
    departing: Vec<bool>,
    period_ms: Option<f64>,
    last_id: Option<FrameId>,
}

impl TemporalMedian {
    /// With checked settings.
    pub fn new(settings: &Settings) -> Result<Self, SettingsError> {
        settings.check()?;
        Ok(Self {
            settings: settings.clone(),
            history: History::default(),
            guard: Guard::default(),
            particles: Particles::default(),
            scene_cut: SceneCut::default(),
            output: Image::filled(0, 0, [0; 3]),
            departs: Vec::new(),
            departing: Vec::new(),
            period_ms: None,
            last_id: None,
        })
    }

    /// What the guard found in the newest frame, one entry per block of 16 × 16 pixels, row by row; empty before there is
    /// enough history.
    pub fn motions(&self) -> &[Motion] {
        &self.guard.motions
    }

    fn notice_gaps(&mut self, frame: &mut Frame) {
        let step_ms = frame.since_previous.milliseconds();
        let follows = self.last_id.is_none_or(|last| frame.id.0 == last.0 + 1);
        let gap = self.period_ms.is_some_and(|period| step_ms > MAX_GAP_PERIODS * period);
        if !follows || gap {
            self.history.clear();
        }
        if step_ms > 0.0 && !gap {
            self.period_ms = Some(self.period_ms.map_or(step_ms, |period| period + 0.1 * (step_ms - period)));
        }
        self.last_id = Some(frame.id);
        if self.scene_cut.is_cut(&frame.image) {
            frame.scene_cut = true;
        }
        if frame.scene_cut {
            self.history.clear();
        }
    }

    /// The window for the newest frame: odd, no longer than the history. Two frames make a window of three in which the
    /// older one counts twice: the median is the older one, and the guard decides whether it knows better.
    fn window(&self) -> usize {
        let wanted = self.period_ms.map_or(3, |period| self.settings.frames_from_period(period));
        let held = self.history.count();
        let held_odd = if held % 2 == 1 { held } else { held.saturating_sub(1) };
        if held == 2 { 3 } else { wanted.min(held_odd) }
    }

    /// Fill `output`, `departs` and `departing` in the blocks that do not move.
    fn median<const N: usize>(&mut self, (width, height): (usize, usize), threshold: u8)
    where
        [Wide; N]: Colors<N>,
    {
        let columns = width.div_ceil(BLOCK);
        let oldest = self.history.count().saturating_sub(1);
        let window = std::array::from_fn(|age| self.history.planes(age.min(oldest)));
        let motions = &self.guard.motions;
        let (method, distance) = (self.settings.method, self.settings.distance);
        self.output
            .pixels_mut()
            .par_chunks_mut(BLOCK * width)
            .zip(self.departs[..width * height].par_chunks_mut(BLOCK * width))
            .zip(self.departing.par_chunks_mut(columns))
            .enumerate()
            .for_each(|(band, ((output, departs), departing))| {
                let motions = &motions[band * columns..(band + 1) * columns];
                let top = band * BLOCK;
                let rows = output.chunks_exact_mut(width).zip(departs.chunks_exact_mut(width));
                for (y, (output, departs)) in rows.enumerate() {
                    let mut block = 0;
                    while block < columns {
                        let idle = is_idle(motions, block);
                        let mut end = block + BLOCKS_PER_TILE;
                        while end < columns && is_idle(motions, end) == idle {
                            end += BLOCKS_PER_TILE;
                        }
                        let (left, right) = (block * BLOCK, (end * BLOCK).min(width));
                        if !idle {
                            wide::run(Run::<N> {
                                window,
                                start: (top + y) * width + left,
                                median: &mut output[left..right],
                                departs: &mut departs[left..right],
                                threshold,
                                method,
                                distance,
                            });
                        }
                        block = end;
                    }
                }
                note_departing(departs, width, motions, departing);
            });
    }
}

/// Whether all blocks of the tile that begins with `block` move.
fn is_idle(motions: &[Motion], block: usize) -> bool {
    motions[block..]
        .iter()
        .take(BLOCKS_PER_TILE)
        .all(|motion| *motion == Motion::Moving)
}

/// Say which blocks of a band depart, and make those that move depart nowhere. On entry `departing` says where `departs` may be set
/// from the frame before.
fn note_departing(departs: &mut [u8], width: usize, motions: &[Motion], departing: &mut [bool]) {
    for (block, (motion, departing)) in motions.iter().zip(departing).enumerate() {
        let left = block * BLOCK;
        let rows = departs.chunks_exact_mut(width).map(|row| &mut row[left..]);
        if *motion == Motion::Moving {
            let computed = !is_idle(motions, block / BLOCKS_PER_TILE * BLOCKS_PER_TILE);
            if computed || *departing {
                for row in rows {
                    match row.first_chunk_mut::<BLOCK>() {
                        Some(row) => *row = [0; BLOCK],
                        None => row.fill(0),
                    }
                }
            }
            *departing = false;
        } else {
            let mut any = 0;
            for row in rows {
                any |= match row.first_chunk::<BLOCK>() {
                    Some(row) => u128::from_ne_bytes(*row),
                    None => row.iter().fold(0, |any, departs| any | u128::from(*departs)),
                };
            }
            *departing = any != 0;
        }
    }
}

impl Stage for TemporalMedian {
    fn name(&self) -> &'static str {
        "temporal_median"
    }

    fn process(&mut self, frame: &mut Frame) -> Result<(), StageError> {
        let size = frame.image.size();
        if size.0 == 0 || size.1 == 0 {
            return Err(StageError(
                "expected a picture, found one without pixels; check the source".to_owned(),
            ));
        }
        self.notice_gaps(frame);
        self.history.push(&frame.image, BLOCK);
        let window = self.window();
        self.guard.clear();
        let period_s = self.period_ms.unwrap_or(40.0) * 1e-3;
        let too_fast = guard::camera_motion_px(frame, period_s).is_some_and(|motion| motion > self.settings.max_camera_motion_px);
        if window < 3 || (too_fast && self.settings.motion_guard) {
            return Ok(());
        }
        if self.output.size() != size {
            self.output.resize(size.0, size.1, [0; 3]);
            self.departs = vec![0; size.0 * size.1];
            self.departing = vec![false; size.0.div_ceil(BLOCK) * size.1.div_ceil(BLOCK)];
        }
        self.guard.judge(&self.history, window, size);
        if !self.settings.motion_guard {
            self.guard.motions.fill(Motion::Still);
        }
        let sigma = self.guard.noise.variance_at(128.0).sqrt() * CHANNEL_OVER_GRAY;
        let two_frames = self.history.count() == 2;
        let caution = if two_frames { TWO_FRAMES_CAUTION } else { 1.0 };
        let threshold = (self.settings.min_particle_levels as f32).max(DEPARTURE_SIGMAS * sigma);
        let threshold = (caution * threshold).min(120.0) as u8;
        match window {
            3 => self.median::<3>(size, threshold),
            5 => self.median::<5>(size, threshold),
            _ => self.median::<7>(size, threshold),
        }
        if !self.settings.motion_guard {
            frame.image.swap(&mut self.output);
            return Ok(());
        }
        let max_extent_px = (self.settings.max_particle_share * size.1 as f64).max(20.0) as usize;
        let evidence = Evidence {
            gray: &self.history.planes(0).gray,
            departs: &self.departs,
            departing: &self.departing,
            stats: &self.guard.stats,
            motions: &self.guard.motions,
            noise: &self.guard.noise,
            max_extent_px,
            particles_only: two_frames,
        };
        self.particles.settle(&evidence, &self.output);
        // The smaller part is copied over to the larger.
        let still = self.guard.motions.iter().filter(|motion| **motion == Motion::Still).count();
        if 2 * still > self.guard.motions.len() && !two_frames {
            self.particles.copy(&evidence, Side::Newest, &frame.image, &mut self.output);
            frame.image.swap(&mut self.output);
        } else {
            self.particles.copy(&evidence, Side::Median, &self.output, &mut frame.image);
        }
        Ok(())
    }

    fn reset(&mut self) {
        self.history.clear();
        self.guard.clear();
        self.guard.noise.clear();
        self.scene_cut.clear();
        self.period_ms = None;
        self.last_id = None;
    }
}
