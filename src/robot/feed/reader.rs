//! The thread that listens to the arm, and what it has to tell.
//!
//! It reads with a time-out, so that it notices within milliseconds when the line falls silent or when it shall stop. If the line
//! breaks it is closed and its path tried again until it is back, as the same device or another. All it shares is
//! bounded: the pose buffer, the counts, and a queue of samples for whoever wants every one.

use std::fmt;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use crossbeam::channel::{Sender, TrySendError};

use crate::robot::feed::clock::ClockEstimate;
use crate::robot::feed::driver::{Driver, Joined, driver};
use crate::robot::feed::intake::{Intake, Refusal};
use crate::robot::feed::line::{Heard, Line, LineSource, READ_TIMEOUT};
use crate::robot::feed::message::Sample;
use crate::robot::feed::settings::{PoseClock, Settings};
use crate::robot::feed::statistics::{FeedStatistics, FeedStatus, LinkState, RecentMessages};
use crate::robot::kinematics::{Arm, ArmError};
use crate::robot::pose_buffer::{self, PoseBuffer, PoseLookupError, StampedPose};
use crate::time::{Clock, Span, Timestamp};

/// Bytes taken at once.
const READ_BYTES: usize = 4096;
/// Bytes without a message for so many times the silence count as garbage; a bad line has gaps.
const GARBLED_AFTER_SILENCES: f64 = 5.0;

/// Why a feed cannot start.
#[derive(Debug, thiserror::Error)]
pub enum FeedError {
    /// A setting cannot be.
    #[error("{0}")]
    Settings(String),
    /// A setting of the pose buffer cannot be.
    #[error(transparent)]
    Poses(#[from] pose_buffer::SettingsError),
    /// No kinematics.
    #[error(transparent)]
    Arm(#[from] ArmError),
    /// The system gave no thread.
    #[error("expected a thread to read the arm, the system gave none: {0}")]
    Thread(std::io::Error),
}

/// The arm's poses, shared with the thread that fills them.
#[derive(Clone, Debug)]
pub struct SharedPoses(Arc<Mutex<PoseBuffer>>);

impl SharedPoses {
    /// Poses that somebody else fills in.
    pub fn new(poses: PoseBuffer) -> Self {
        Self(Arc::new(Mutex::new(poses)))
    }

    /// Where the hand was at `instant`.
    pub fn pose_at(&self, instant: Timestamp) -> Result<StampedPose, PoseLookupError> {
        self.lock().pose_at(instant)
    }

    /// The buffer itself; the reader waits as long as it is held.
    pub fn lock(&self) -> MutexGuard<'_, PoseBuffer> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// What the reader tells.
#[derive(Debug)]
struct Told {
    link: LinkState,
    since: Timestamp,
    recent: RecentMessages,
    last: Option<Sample>,
    clock: Option<ClockEstimate>,
    status: u8,
    faults: u16,
    refusal: Option<Refusal>,
    statistics: FeedStatistics,
}

/// A running feed; dropping it stops it.
pub struct ArmFeed {
    poses: SharedPoses,
    told: Arc<Mutex<Told>>,
    stop: Arc<AtomicBool>,
    clock: Arc<dyn Clock>,
    thread: Option<JoinHandle<()>>,
}

impl fmt::Debug for ArmFeed {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("ArmFeed").field("told", &self.told).finish_non_exhaustive()
    }
}

/// The arm that the settings name.
pub fn arm_of(settings: &Settings) -> Result<Arm, ArmError> {
    if settings.kinematics.is_empty() {
        Arm::aesop_3000()
    } else {
        Arm::read(Path::new(&settings.kinematics))
    }
}

impl ArmFeed {
    /// Start to listen. A port that is not there is waited for. Every sample also goes into `tap`, if there is room; a file waits for
    /// room.
    pub fn start(
        source: LineSource,
        settings: &Settings,
        poses: &pose_buffer::Settings,
        clock: Arc<dyn Clock>,
        tap: Option<Sender<Sample>>,
    ) -> Result<Self, FeedError> {
        Self::start_with(driver(settings.protocol), source, settings, poses, clock, tap)
    }

    /// The same, with a driver of one's own.
    pub fn start_with(
        driver: Box<dyn Driver>,
        source: LineSource,
        settings: &Settings,
        poses: &pose_buffer::Settings,
        clock: Arc<dyn Clock>,
        tap: Option<Sender<Sample>>,
    ) -> Result<Self, FeedError> {
        settings.check().map_err(FeedError::Settings)?;
        let poses = SharedPoses::new(PoseBuffer::new(poses)?);
        let told = Arc::new(Mutex::new(Told {
            link: LinkState::Silent,
            since: clock.now(),
            recent: RecentMessages::default(),
            last: None,
            clock: None,
            status: 0,
            faults: 0,
            refusal: None,
            statistics: FeedStatistics::default(),
        }));
        let stop = Arc::new(AtomicBool::new(false));
        let reader = Reader {
            source,
            driver,
            intake: Intake::new(arm_of(settings)?, settings),
            settings: settings.clone(),
            poses: poses.clone(),
            told: Arc::clone(&told),
            stop: Arc::clone(&stop),
            clock: Arc::clone(&clock),
            tap,
        };
        let thread = std::thread::Builder::new()
            .name("arm feed".into())
            .spawn(move || reader.run())
            .map_err(FeedError::Thread)?;
        Ok(Self {
            poses,
            told,
            stop,
            clock,
            thread: Some(thread),
        })
    }

    /// The poses of the last seconds.
    pub fn poses(&self) -> &SharedPoses {
        &self.poses
    }

    /// How it goes right now.
    pub fn status(&self) -> FeedStatus {
        let now = self.clock.now();
        let told = lock(&self.told);
        let (rate_hz, delays) = told.recent.summary(now);
        FeedStatus {
            link: told.link.clone(),
            since: told.since,
            rate_hz,
            delays,
            status: told.status,
            faults: told.faults,
            last: told.last,
            refusal: told.refusal.as_ref().map(ToString::to_string),
            clock: told.clock,
            statistics: told.statistics,
        }
    }

    /// True when the thread has come to the end of its file, or broke.
    pub fn has_ended(&self) -> bool {
        self.thread.as_ref().is_none_or(JoinHandle::is_finished)
    }

    /// Stop, and all that was counted.
    pub fn stop(mut self) -> FeedStatistics {
        self.join();
        lock(&self.told).statistics
    }

    fn join(&mut self) {
        self.stop.store(true, Ordering::Release);
        if let Some(thread) = self.thread.take()
            && thread.join().is_err()
        {
            tracing::error!("the thread that reads the arm ended by a fault of this program");
        }
    }
}

impl Drop for ArmFeed {
    fn drop(&mut self) {
        self.join();
    }
}

fn lock(told: &Mutex<Told>) -> MutexGuard<'_, Told> {
    told.lock().unwrap_or_else(PoisonError::into_inner)
}

struct Reader {
    source: LineSource,
    driver: Box<dyn Driver>,
    intake: Intake,
    settings: Settings,
    poses: SharedPoses,
    told: Arc<Mutex<Told>>,
    stop: Arc<AtomicBool>,
    clock: Arc<dyn Clock>,
    tap: Option<Sender<Sample>>,
}

/// When something last came over the line that is open now.
#[derive(Clone, Copy, Debug)]
struct Heartbeat {
    byte: Timestamp,
    message: Timestamp,
    looked: Timestamp,
}

impl Reader {
    fn run(mut self) {
        while !self.stopping() {
            match Line::open(&self.source, &self.settings) {
                Ok(line) => {
                    if !self.listen(line) {
                        return;
                    }
                }
                Err(error) => self.set_link(LinkState::Absent(error.to_string())),
            }
            self.pause(Duration::from_secs_f64(self.settings.reopen_ms * 1e-3));
        }
    }

    fn stopping(&self) -> bool {
        self.stop.load(Ordering::Acquire)
    }

    /// Sleep, but wake up to stop.
    fn pause(&self, length: Duration) {
        let mut left = length;
        while !left.is_zero() && !self.stopping() {
            let nap = left.min(READ_TIMEOUT);
            std::thread::sleep(nap);
            left -= nap;
        }
    }

    /// Until the line breaks (true) or there is nothing more to hear (false).
    fn listen(&mut self, mut line: Line) -> bool {
        let is_port = matches!(self.source, LineSource::Port(_));
        self.driver.reset(if is_port { Joined::Midway } else { Joined::AtStart });
        let greeting = self.driver.greeting().to_vec();
        if let Err(error) = line.write_all(&greeting) {
            self.hang_up(&error.to_string());
            return true;
        }
        let now = self.clock.now();
        let mut heartbeat = Heartbeat {
            byte: now,
            message: now,
            looked: now,
        };
        self.intake.statistics().opened += 1;
        if self.intake.statistics().opened > 1 {
            tracing::info!("arm: the line is back");
        }
        self.set_link(LinkState::Silent);
        self.tell();
        let mut buffer = [0; READ_BYTES];
        while !self.stopping() {
            match line.read(&mut buffer) {
                Ok(Heard::Bytes(count)) => {
                    let now = self.clock.now();
                    heartbeat.byte = now;
                    if self.take(buffer.get(..count).unwrap_or(&[]), now) {
                        heartbeat.message = now;
                        self.set_link(LinkState::Speaking);
                    }
                    self.look(&heartbeat, now);
                }
                Ok(Heard::Nothing) => {
                    let now = self.clock.now();
                    self.look(&heartbeat, now);
                    // Some adapters vanish without an error; some paths come back as another device.
                    if now - heartbeat.byte > self.silence() && (now - heartbeat.looked).milliseconds() >= self.settings.reopen_ms
                    {
                        heartbeat.looked = now;
                        if line.is_elsewhere(&self.source) {
                            self.hang_up("its path leads elsewhere now");
                            return true;
                        }
                    }
                }
                Ok(Heard::End) => {
                    self.tell();
                    self.set_link(LinkState::Ended);
                    return false;
                }
                Err(error) => {
                    self.hang_up(&error.to_string());
                    // A file or a pipe that broke does not come back.
                    return is_port;
                }
            }
        }
        false
    }

    fn silence(&self) -> Span {
        Span::from_milliseconds(self.settings.silence_ms)
    }

    fn look(&mut self, heartbeat: &Heartbeat, now: Timestamp) {
        // A file does not fall silent.
        if matches!(self.source, LineSource::File(_)) {
            return;
        }
        let garbled_after = Span::from_milliseconds(self.settings.silence_ms * GARBLED_AFTER_SILENCES);
        if now - heartbeat.byte > self.silence() {
            if !matches!(lock(&self.told).link, LinkState::Silent) {
                self.intake.statistics().silences += 1;
                self.set_link(LinkState::Silent);
                self.tell();
            }
        } else if now - heartbeat.message > garbled_after {
            self.set_link(LinkState::Garbled);
        }
    }

    /// True when a message was among the bytes.
    fn take(&mut self, bytes: &[u8], arrival: Timestamp) -> bool {
        let (intake, poses, tap, stop, told) = (&mut self.intake, &self.poses, &self.tap, &self.stop, &self.told);
        let waits = matches!(self.source, LineSource::File(_));
        let on_device_clock = self.settings.clock == PoseClock::Device;
        let mut any = false;
        self.driver.take(bytes, &mut |message| {
            any = true;
            let restarts = intake.statistics().restarts;
            let taken = intake.take(message, arrival);
            if on_device_clock && intake.statistics().restarts > restarts {
                poses.lock().clear();
            }
            let mut told = lock(told);
            (told.status, told.faults) = (message.status, message.faults);
            let accepted = match taken {
                Ok(accepted) => accepted,
                Err(Refusal::Repeated) => return,
                Err(refusal) => {
                    told.refusal = Some(refusal);
                    return;
                }
            };
            told.recent.push(arrival, accepted.delay);
            told.last = Some(accepted.sample);
            drop(told);
            intake.statistics().out_of_order += u64::from(!poses.lock().push(accepted.sample.pose));
            if let Some(tap) = tap {
                intake.statistics().overrun += u64::from(!pass_on(tap, accepted.sample, waits, stop));
            }
        });
        self.tell();
        any
    }

    /// Bring what others see up to date.
    fn tell(&mut self) {
        let counts = self.driver.counts();
        let clock = self.intake.clock();
        let statistics = self.intake.statistics();
        statistics.set_driver_counts(&counts);
        let mut told = lock(&self.told);
        told.statistics = *statistics;
        told.clock = clock;
    }

    fn hang_up(&mut self, reason: &str) {
        self.intake.statistics().hang_ups += 1;
        self.tell();
        self.set_link(LinkState::Absent(format!("the line broke: {reason}")));
    }

    fn set_link(&mut self, link: LinkState) {
        let now = self.clock.now();
        let mut told = lock(&self.told);
        if told.link == link {
            return;
        }
        // The reason why a port is not back yet may change; that it is gone has been told.
        let is_news = told.link.word() != link.word();
        if is_news {
            told.since = now;
        }
        told.link = link.clone();
        drop(told);
        if is_news {
            match link {
                LinkState::Absent(reason) => tracing::warn!("arm: {reason}"),
                LinkState::Silent => tracing::debug!("arm: the line is silent"),
                LinkState::Garbled => tracing::warn!(
                    "arm: bytes come, but no messages; are arm.protocol ({}) and arm.baud ({}) right?",
                    self.driver.name(),
                    self.settings.baud
                ),
                LinkState::Speaking => tracing::debug!("arm: messages come"),
                LinkState::Ended => tracing::debug!("arm: the end"),
            }
        }
    }
}

/// False when there was no room.
fn pass_on(tap: &Sender<Sample>, sample: Sample, waits: bool, stop: &AtomicBool) -> bool {
    let mut sample = sample;
    loop {
        match tap.try_send(sample) {
            Ok(()) => return true,
            // Nobody listens any more: nothing is lost.
            Err(TrySendError::Disconnected(_)) => return true,
            Err(TrySendError::Full(_)) if !waits || stop.load(Ordering::Acquire) => return false,
            Err(TrySendError::Full(back)) => {
                sample = back;
                std::thread::sleep(Duration::from_millis(1));
            }
        }
    }
}
