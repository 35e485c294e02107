//! How a live line is doing, in a line for people and as JSON for machines.

use serde_json::{Value, json};

use crate::calibration::time_offset::drift::Verdict;
use crate::cli::live::session::{LightFieldState, Session};
use crate::pipeline::runner::StageStatus;
use crate::pipeline::seat::Condition;
use crate::pipeline::timing::Summary;
use crate::robot::feed::statistics::FeedStatus;
use crate::sinks::meter::Coverage;
use crate::sinks::recorder::{Recorded, RecorderReading, Track};
use crate::sinks::virtual_camera::VirtualCameraStatus;
use crate::sources::camera::capture::CaptureStatus;
use crate::time::{Span, Timestamp};

/// Everything worth telling at an instant.
#[derive(Debug)]
pub struct Snapshot {
    /// Frames a second that came out, lately.
    pub frames_per_second: f64,
    /// From arrival to the end of the line, lately.
    pub latency: Summary,
    frames_in: u64,
    frames_out: u64,
    dropped: u64,
    rescued: u64,
    overtaken: u64,
    stages: Vec<StageStatus>,
    camera: Option<CaptureStatus>,
    arm: Option<FeedStatus>,
    drift: Option<Verdict>,
    recorder: Option<Recorded>,
    enhanced_recorder: Option<Recorded>,
    virtual_camera: Option<VirtualCameraStatus>,
    light_field: LightFieldState,
    coverage: Coverage,
}

/// Counts frames a second.
#[derive(Debug, Default)]
pub struct Rate {
    last: Option<(Timestamp, u64)>,
    frames_per_second: f64,
}

/// The rate is that of so long.
const RATE_OVER: Span = Span(1_000_000_000);

impl Rate {
    fn look(&mut self, now: Timestamp, frames: u64) -> f64 {
        match self.last {
            Some((then, before)) if now - then >= RATE_OVER => {
                self.frames_per_second = frames.saturating_sub(before) as f64 / (now - then).seconds();
                self.last = Some((now, frames));
            }
            Some(_) => {}
            None => self.last = Some((now, frames)),
        }
        self.frames_per_second
    }
}

/// What is recorded; lost is as well what a recorder was too slow for.
fn recorded(session: &Session, reading: Option<&RecorderReading>, track: Track) -> Option<Recorded> {
    let mut recorded = reading?.get();
    recorded.lost += session.line.dropped_before(track.sink_name());
    Some(recorded)
}

impl Snapshot {
    /// Look at everything.
    pub fn of(session: &mut Session, rate: &mut Rate, now: Timestamp) -> Self {
        let status = session.line.status();
        let light_field = session.light_field();
        Self {
            frames_per_second: rate.look(now, status.frames_out),
            latency: session.line.recent_latency(),
            frames_in: status.frames_in,
            frames_out: status.frames_out,
            dropped: status.frames_dropped,
            rescued: status.passed.rescued,
            overtaken: status.passed.overtaken,
            stages: session.line.stages(),
            camera: session.camera.as_ref().map(|camera| camera.status()),
            arm: session.arm.as_ref().map(|arm| arm.status()),
            drift: session.drift.as_ref().and_then(|drift| drift.get()),
            recorder: recorded(session, session.recorder.as_ref(), Track::Raw),
            enhanced_recorder: recorded(session, session.enhanced_recorder.as_ref(), Track::Enhanced),
            virtual_camera: session.virtual_camera.as_ref().map(|camera| camera.get()),
            light_field,
            coverage: session.meter.coverage(),
        }
    }

    /// For people.
    pub fn line(&self) -> String {
        let mut text = String::new();
        if let Some(camera) = self.camera.as_ref().filter(|camera| camera.state.word() != "streaming") {
            text += &format!("camera {} · ", camera.state.word());
        }
        text += &format!(
            "{:.1} fps · latency p50 {:.1} ms, p99 {:.1} ms",
            self.frames_per_second, self.latency.p50_ms, self.latency.p99_ms
        );
        text += &format!(" · dropped {} · late {}", self.dropped, self.rescued);
        if let Some(arm) = &self.arm {
            text += &format!(" · arm {} {:.0} Hz", arm.link.word(), arm.rate_hz);
        }
        if let Some(Verdict::Drifted { .. }) = self.drift {
            text += " · CLOCKS DISAGREE";
        }
        if self.light_field != LightFieldState::None {
            text += &format!(" · light field {}", self.light_field.word());
            if let Some(share) = self.coverage.share().filter(|_| self.light_field == LightFieldState::Ready) {
                text += &format!(", covers {:.0} %", 100.0 * share);
            }
        }
        if let Some(camera) = self.virtual_camera.as_ref().filter(|camera| camera.failure.is_some()) {
            text += &format!(" · NO VIRTUAL CAMERA, {} lost", camera.lost);
        }
        if let Some(recorder) = &self.recorder {
            text += &format!(" · recorded {}", recorder.frames);
            if recorder.lost > 0 {
                text += &format!(", LOST {}", recorder.lost);
            }
        }
        for stage in &self.stages {
            match stage.condition {
                Condition::Working | Condition::SwitchedOff => {}
                condition => text += &format!(" · {} {}", stage.name, condition_word(condition)),
            }
        }
        text
    }

    /// For machines.
    pub fn json(&self, event: &str) -> Value {
        json!({
            "event": event,
            "task": "live",
            "frames_per_second": self.frames_per_second,
            "latency": self.latency,
            "frames": {
                "in": self.frames_in,
                "out": self.frames_out,
                "dropped_at_entry": self.dropped,
                "shown_as_they_came": self.rescued,
                "overtaken": self.overtaken,
            },
            "stages": self.stages.iter().map(|stage| json!({
                "name": stage.name,
                "condition": condition_word(stage.condition),
                "expected_ms": stage.expected.milliseconds(),
            })).collect::<Vec<_>>(),
            "camera": self.camera.as_ref().map(|camera| json!({
                "state": camera.state.word(),
                "mode": camera.mode.map(|mode| mode.to_string()),
                "frames": camera.frames,
                "missed": camera.missed,
                "damaged": camera.damaged,
                "broken": camera.broken,
                "stale": camera.stale,
                "opened": camera.opened,
                "interruptions": camera.interruptions,
            })),
            "arm": self.arm.as_ref().map(|arm| json!({
                "link": arm.link.word(),
                "rate_hz": arm.rate_hz,
                "delay_p99_ms": arm.delays.p99.milliseconds(),
                "statistics": arm.statistics,
            })),
            "clocks": self.drift.map(|verdict| match verdict {
                Verdict::Agree => json!({"verdict": "agree"}),
                Verdict::Silent => json!({"verdict": "silent"}),
                Verdict::Drifted { offset, sigma_ms } => json!({
                    "verdict": "drifted",
                    "offset_ms": offset.milliseconds(),
                    "sigma_ms": sigma_ms,
                }),
            }),
            "light_field": self.light_field.word(),
            "covered": self.coverage.share(),
            "recorder": self.recorder,
            "enhanced_recorder": self.enhanced_recorder,
            "virtual_camera": self.virtual_camera,
        })
    }
}

fn condition_word(condition: Condition) -> &'static str {
    match condition {
        Condition::Working => "working",
        Condition::SwitchedOff => "off",
        Condition::Resting => "RESTS",
        Condition::Hanging => "HANGS",
        Condition::Broken => "BROKEN",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_rate_is_that_of_the_last_second() {
        let mut rate = Rate::default();
        let at = Timestamp::from_seconds;
        assert_eq!(rate.look(at(0.0), 0), 0.0);
        assert_eq!(rate.look(at(0.5), 15), 0.0);
        assert!((rate.look(at(1.0), 30) - 30.0).abs() < 1e-9);
        assert!((rate.look(at(1.5), 60) - 30.0).abs() < 1e-9);
        assert!((rate.look(at(2.0), 90) - 60.0).abs() < 1e-9);
    }
}
