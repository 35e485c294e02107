//! Where the median may speak: block by block from the picture, as a whole from the arm's speed.

use rayon::iter::{IndexedParallelIterator as _, ParallelIterator as _};
use rayon::slice::ParallelSliceMut as _;

use crate::frame::Frame;
use crate::image::wide;
use crate::stages::temporal_median::history::History;
use crate::stages::temporal_median::motion::{self, BLOCK, BlockRow, BlockStats, LAGS, Motion, Share};
use crate::stages::temporal_median::noise::Noise;

/// Distance at which the arm's speed is turned into picture speed when nobody knows the depth, mm.
const TYPICAL_DISTANCE_MM: f64 = 80.0;
/// Focal length over picture width of a scope that is not calibrated (about 60° across).
const TYPICAL_FOCAL_SHARE: f64 = 0.85;
/// Particles in the newest frame differ from the history by more than this many standard deviations.
const OUTLIER_SIGMAS: f32 = 5.0;

/// The motion guard's state and buffers.
#[derive(Debug, Default)]
pub struct Guard {
    /// Per block.
    pub stats: Vec<BlockStats>,
    /// Per block.
    pub motions: Vec<Motion>,
    /// Learnt over the frames.
    pub noise: Noise,
    shares: Vec<Share>,
}

impl Guard {
    /// Forget the scene; the noise is the camera's and stays.
    pub fn clear(&mut self) {
        self.stats.clear();
        self.motions.clear();
    }

    /// Judge every block of the newest frame against `window` frames of history.
    pub fn judge(&mut self, history: &History, window: usize, (width, height): (usize, usize)) {
        let columns = width.div_ceil(BLOCK);
        let rows = height.div_ceil(BLOCK);
        self.stats.resize(columns * rows, BlockStats::default());
        self.motions.resize(columns * rows, Motion::Moving);
        let held = history.count().saturating_sub(1);
        let older: [usize; LAGS] = [(window / 2).min(held), (window - 1).min(held)];
        let sigma = self.noise.variance_at(128.0).sqrt();
        let inlier_bound = (OUTLIER_SIGMAS * std::f32::consts::SQRT_2 * sigma + 4.0).clamp(10.0, 63.0) as u8;
        let band = BLOCK * width;
        self.stats.par_chunks_mut(columns).enumerate().for_each(|(row, stats)| {
            let part = row * band..((row + 1) * band).min(width * height);
            wide::run(BlockRow {
                newest: &history.planes(0).gray[part.clone()],
                older: older.map(|age| &history.planes(age).gray[part.clone()]),
                width,
                inlier_bound,
                stats,
            });
        });
        self.noise.learn(&self.stats);
        motion::classify(&self.stats, columns, &self.noise, &mut self.shares, &mut self.motions);
    }
}

/// How far the arm moves the picture from one frame to the next, px, if it tells its speed.
pub fn camera_motion_px(frame: &Frame, period_s: f64) -> Option<f64> {
    let (translation_mm_s, rotation_rad_s) = frame.camera_speed?;
    let focal_px = frame
        .camera
        .as_ref()
        .map_or(frame.image.width() as f64 * TYPICAL_FOCAL_SHARE, |camera| {
            camera.intrinsics.fx
        });
    Some((translation_mm_s / TYPICAL_DISTANCE_MM + rotation_rad_s) * focal_px * period_s)
}
