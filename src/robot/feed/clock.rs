//! From the device's clock to the host's.
//!
//! A message that was true at device time d arrives at host time (1 + drift)·d + offset + delay. The delay is never below that of
//! the wire, often just that, and now and then much more (the host was busy, the adapter collected bytes): its noise is one-sided.
//! Averaging would follow the noise; the lower envelope of arrival − d does not (Moon, Skelly and Towsley 1999, "Estimation and
//! removal of clock skew from network delay measurements", DOI 10.1109/INFCOM.1999.749301). So time is cut into bins, each keeps
//! its least delayed message, the drift is the median slope between the bins' minima (Theil–Sen; a host stalled for a whole bin
//! does no harm), and the offset is the least that the last bins say, drift taken out. If delays above the best are exponential with mean τ and a
//! bin holds n messages, a minimum is τ/n late on average. What is the same in every message (the wire, the arm's own filter)
//! cannot be seen from here: that is for `calibrate time-offset`.

use std::collections::VecDeque;

use crate::robot::feed::message::DeviceTime;
use crate::time::{Span, Timestamp};

const BIN: Span = Span(1_000_000_000);
/// The drift is taken from so many bins: two minutes, over which a crystal's own drift changes little.
const DRIFT_BINS: usize = 120;
/// The offset is taken from so many bins: short enough that an error of the drift does not add up.
const OFFSET_BINS: usize = 10;
/// From fewer bins the drift says more about delays than about the clock.
const FEWEST_DRIFT_BINS: usize = 8;
/// A 32-bit counter of microseconds wraps after so many ns.
const WRAP: i64 = (1 << 32) * 1000;
/// No queue between arm and host holds messages longer than this: a larger step is another clock.
const LARGEST_STEP: Span = Span(3_000_000_000);

/// What is known of the device's clock.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ClockEstimate {
    /// The host's time less the device's, now.
    pub offset: Span,
    /// How much faster the host's clock runs than the device's, parts per million; `None` until it is known.
    pub drift_ppm: Option<f64>,
}

/// A device's time carried to the host.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Mapped {
    /// When it was true, on the host's clock, if the way took the least delay seen.
    pub host: Timestamp,
    /// How much longer than the least it took; never negative.
    pub delay: Span,
    /// True when the device's clock was found to have started anew.
    pub restarted: bool,
}

/// Follows one device's clock.
#[derive(Clone, Debug)]
pub struct DeviceClock {
    max_drift_ppm: f64,
    /// The last device time, unwrapped, and its arrival.
    last: Option<(i64, Timestamp)>,
    /// The first arrival since the clock started: times below count from here, so that f64 holds them to the nanosecond.
    origin: (i64, i64),
    /// Oldest first; the last one is being filled.
    bins: VecDeque<Bin>,
    drift: f64,
}

/// The least delayed message of a bin, ns since the origin.
#[derive(Clone, Copy, Debug)]
struct Bin {
    began: i64,
    device: i64,
    lateness: i64,
}

impl DeviceClock {
    /// A clock that is off by at most `max_drift_ppm`.
    pub fn new(max_drift_ppm: f64) -> Self {
        Self {
            max_drift_ppm,
            last: None,
            origin: (0, 0),
            bins: VecDeque::new(),
            drift: 0.0,
        }
    }

    /// Forget everything: the device started anew.
    pub fn reset(&mut self) {
        *self = Self::new(self.max_drift_ppm);
    }

    /// One message: its device time and when it arrived.
    pub fn map(&mut self, device_time: DeviceTime, arrival: Timestamp) -> Mapped {
        let mut restarted = false;
        let mut device = self.unwrapped(device_time, arrival);
        if let Some((last, last_arrival)) = self.last {
            let elapsed = arrival - last_arrival;
            let off = Span(device.saturating_sub(last).saturating_sub(elapsed.0).saturating_abs());
            let allowed = LARGEST_STEP.0 + (elapsed.0.saturating_abs() as f64 * self.max_drift_ppm * 1e-6) as i64;
            if off.0 > allowed {
                self.reset();
                restarted = true;
                device = self.unwrapped(device_time, arrival);
            }
        }
        if self.last.is_none() {
            self.origin = (device, arrival.0);
        }
        // A message that waited in a queue must not pull the expectation back.
        if self.last.is_none_or(|(last, _)| device >= last) {
            self.last = Some((device, arrival));
        }
        let since = device.saturating_sub(self.origin.0);
        let lateness = arrival.0.saturating_sub(self.origin.1).saturating_sub(since);
        self.note(since, lateness);
        let offset = self.offset_at(since).unwrap_or(lateness);
        let host = Timestamp(self.origin.1.saturating_add(since).saturating_add(offset));
        Mapped {
            host: host.min(arrival),
            delay: Span((arrival - host).0.max(0)),
            restarted,
        }
    }

    /// The device's time as it is, a wrapping counter made to go on. For files, where the host's clock says nothing.
    pub fn alone(&mut self, device_time: DeviceTime) -> Timestamp {
        let device = match (device_time, self.last) {
            (DeviceTime::Nanoseconds(nanoseconds), _) => nanoseconds,
            (DeviceTime::Microseconds32(ticks), None) => i64::from(ticks) * 1000,
            (DeviceTime::Microseconds32(ticks), Some((last, _))) => {
                // As signed, so that a message out of order does not count as a wrap.
                let step = ticks.wrapping_sub(last.div_euclid(1000) as u32).cast_signed();
                last.saturating_add(i64::from(step) * 1000)
            }
        };
        self.last = Some((device, Timestamp(device)));
        Timestamp(device)
    }

    /// What is known by now.
    pub fn estimate(&self) -> Option<ClockEstimate> {
        let (device, _) = self.last?;
        let offset = self.offset_at(device.saturating_sub(self.origin.0))?;
        Some(ClockEstimate {
            offset: Span(self.origin.1.saturating_sub(self.origin.0).saturating_add(offset)),
            drift_ppm: (self.bins.len() > FEWEST_DRIFT_BINS).then_some(self.drift * 1e6),
        })
    }

    /// Device time in ns; a wrapping counter is taken to have wrapped as often as fits the time that has passed here.
    fn unwrapped(&self, time: DeviceTime, arrival: Timestamp) -> i64 {
        let ticks = match time {
            DeviceTime::Nanoseconds(nanoseconds) => return nanoseconds,
            DeviceTime::Microseconds32(ticks) => i64::from(ticks) * 1000,
        };
        let Some((last, last_arrival)) = self.last else {
            return ticks;
        };
        let expected = last.saturating_add((arrival - last_arrival).0);
        let ahead = ticks.wrapping_sub(expected).rem_euclid(WRAP);
        expected.saturating_add(if ahead >= WRAP / 2 { ahead - WRAP } else { ahead })
    }

    fn note(&mut self, device: i64, lateness: i64) {
        match self.bins.back_mut() {
            Some(bin) if (bin.began..bin.began.saturating_add(BIN.0)).contains(&device) => {
                // The drift within a second is far below the delays' noise.
                if lateness < bin.lateness {
                    (bin.device, bin.lateness) = (device, lateness);
                }
            }
            // One that waited so long says nothing.
            Some(bin) if device < bin.began => {}
            _ => {
                self.drift = self.median_slope();
                if self.bins.len() == DRIFT_BINS {
                    self.bins.pop_front();
                }
                self.bins.push_back(Bin {
                    began: device,
                    device,
                    lateness,
                });
            }
        }
    }

    /// Theil–Sen over the bins' minima; 0 until there are enough.
    fn median_slope(&self) -> f64 {
        if self.bins.len() < FEWEST_DRIFT_BINS {
            return 0.0;
        }
        let half = self.bins.len() / 2;
        // Pairs far apart only: near ones are all noise, and half as many are enough.
        let mut slopes: Vec<f64> = self
            .bins
            .iter()
            .zip(self.bins.iter().skip(half))
            .map(|(a, b)| b.lateness.saturating_sub(a.lateness) as f64 / b.device.saturating_sub(a.device).max(1) as f64)
            .collect();
        slopes.sort_unstable_by(f64::total_cmp);
        let limit = self.max_drift_ppm * 1e-6;
        slopes.get(slopes.len() / 2).map_or(0.0, |slope| slope.clamp(-limit, limit))
    }

    /// The least lateness of the last bins, carried to device time `device` with the drift.
    fn offset_at(&self, device: i64) -> Option<i64> {
        let lateness = |bin: &Bin| bin.lateness as f64 + self.drift * device.saturating_sub(bin.device) as f64;
        let recent = self.bins.iter().rev().take(OFFSET_BINS);
        recent.map(lateness).min_by(f64::total_cmp).map(|ns| ns.round() as i64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng as _;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::Distribution as _;

    const LIMIT_PPM: f64 = 300.0;

    /// A device that counts from `first_ticks` and whose clock is slow by `ppm`: messages every `period_s`, with the host's truth
    /// and a delay of 4 ms and an exponential with mean `jitter_ms`.
    struct Device {
        first_ticks: u64,
        ppm: f64,
        period_s: f64,
        jitter_ms: f64,
    }

    const WIRE_S: f64 = 0.004;

    impl Device {
        fn messages(&self, seconds: f64, seed: u64) -> Vec<(DeviceTime, f64, Timestamp)> {
            let mut random = ChaCha8Rng::seed_from_u64(seed);
            let exponential = rand_distr::Exp::new(1.0).unwrap();
            let mut earliest = 0.0_f64;
            (0..(seconds / self.period_s) as usize)
                .map(|i| {
                    let truth = 1000.0 + i as f64 * self.period_s;
                    let device_us = (i as f64 * self.period_s / (1.0 + self.ppm * 1e-6) * 1e6).round() as u64;
                    let jitter: f64 = exponential.sample(&mut random);
                    // A line keeps the order.
                    earliest = earliest.max(truth + WIRE_S + jitter * self.jitter_ms * 1e-3);
                    let ticks = (self.first_ticks + device_us) as u32;
                    (DeviceTime::Microseconds32(ticks), truth, Timestamp::from_seconds(earliest))
                })
                .collect()
        }
    }

    fn late_ms(mapped: &Mapped, truth: f64) -> f64 {
        (mapped.host.seconds() - truth - WIRE_S) * 1e3
    }

    #[test]
    fn jitter_and_drift_are_filtered_across_a_wrap() {
        // Wraps after 100 s.
        let device = Device {
            first_ticks: (1 << 32) - 100_000_000,
            ppm: 80.0,
            period_s: 0.01,
            jitter_ms: 2.0,
        };
        let mut clock = DeviceClock::new(LIMIT_PPM);
        let (mut sum, mut count, mut worst) = (0.0, 0.0, 0.0_f64);
        for (time, truth, arrival) in device.messages(240.0, 1) {
            let mapped = clock.map(time, arrival);
            assert!(!mapped.restarted);
            if truth > 1030.0 {
                let late = late_ms(&mapped, truth);
                sum += late;
                count += 1.0;
                worst = worst.max(late.abs());
            }
        }
        // Minima of 100 exponentials of 2 ms are 0.02 ms late; the least of ten of them 0.002 ms. The slope of minima of that
        // noise over 30 s and more is good to 0.02 ms·√2/15 s ≈ 2 ppm, which over the ten seconds of the offset makes 0.02 ms.
        assert!(worst < 0.1, "worst {worst} ms");
        assert!((sum / count).abs() < 0.03, "mean {} ms", sum / count);
        let drift = clock.estimate().unwrap().drift_ppm.unwrap();
        // Over 120 s: 0.02 ms·√2/60 s, less for the median of sixty.
        assert!((drift - 80.0).abs() < 1.0, "{drift} ppm");
    }

    #[test]
    fn before_the_drift_is_known_the_error_is_bounded() {
        let device = Device {
            first_ticks: 0,
            ppm: -100.0,
            period_s: 0.02,
            jitter_ms: 1.0,
        };
        let mut clock = DeviceClock::new(LIMIT_PPM);
        for (time, truth, arrival) in device.messages(9.0, 2).into_iter().skip(100) {
            let mapped = clock.map(time, arrival);
            // Nine seconds of 100 ppm, and a minimum of at least 50 exponentials of 1 ms that may be the first ones.
            if truth > 1004.0 {
                assert!(late_ms(&mapped, truth).abs() < 0.9 + 0.2, "{}", late_ms(&mapped, truth));
            }
        }
    }

    #[test]
    fn a_stalled_host_and_a_silent_line_do_no_harm() {
        let device = Device {
            first_ticks: 5,
            ppm: 30.0,
            period_s: 0.01,
            jitter_ms: 0.5,
        };
        let mut clock = DeviceClock::new(LIMIT_PPM);
        for (time, truth, arrival) in device.messages(200.0, 3) {
            let since = truth - 1000.0;
            // From 60 s the line is silent for 20 s; from 120 s the host sleeps for 1.5 s and finds everything at once.
            if (60.0..80.0).contains(&since) {
                continue;
            }
            let arrival = if (120.0..121.5).contains(&since) {
                arrival.max(Timestamp::from_seconds(1121.5))
            } else {
                arrival
            };
            let mapped = clock.map(time, arrival);
            assert!(!mapped.restarted && mapped.host <= arrival);
            if since > 20.0 {
                assert!(
                    late_ms(&mapped, truth).abs() < 0.1,
                    "{} ms at {since} s",
                    late_ms(&mapped, truth)
                );
            }
            if (120.0..121.0).contains(&since) {
                assert!(mapped.delay > Span::from_milliseconds(400.0));
            }
        }
    }

    #[test]
    fn a_reboot_is_noticed_and_learned_anew() {
        let device = Device {
            first_ticks: 0,
            ppm: 0.0,
            period_s: 0.01,
            jitter_ms: 0.2,
        };
        let mut clock = DeviceClock::new(LIMIT_PPM);
        let mut restarts = 0;
        let messages = device.messages(60.0, 4);
        for (i, (time, truth, arrival)) in messages.iter().enumerate() {
            let time = match time {
                DeviceTime::Microseconds32(ticks) if i >= 3000 => DeviceTime::Microseconds32(ticks - 30_000_000),
                time => *time,
            };
            let mapped = clock.map(time, *arrival);
            restarts += usize::from(mapped.restarted);
            // One second of messages at 0.2 ms: the best is late by 0.002 ms; just after the reboot there is but one.
            if (i % 3000) > 100 {
                assert!(late_ms(&mapped, *truth).abs() < 0.05);
            }
        }
        assert_eq!(restarts, 1);
    }

    #[test]
    fn alone_a_counter_goes_on_over_its_wrap() {
        let mut clock = DeviceClock::new(LIMIT_PPM);
        let stamps: Vec<i64> = [4_294_960_000, 4_294_967_295, 4_704, 24_704]
            .map(|ticks| clock.alone(DeviceTime::Microseconds32(ticks)).0)
            .into();
        assert_eq!(stamps[3] - stamps[2], 20_000_000);
        assert_eq!(stamps[2] - stamps[0], 12_000_000);
    }

    #[test]
    fn absurd_times_are_survived() {
        let mut clock = DeviceClock::new(LIMIT_PPM);
        for time in [i64::MAX, i64::MIN, 0, i64::MAX, -1] {
            for arrival in [0, i64::MAX, i64::MIN, 5] {
                clock.map(DeviceTime::Nanoseconds(time), Timestamp(arrival));
                clock.map(DeviceTime::Microseconds32(u32::MAX), Timestamp(arrival));
            }
        }
    }
}
