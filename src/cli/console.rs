//! What the user sees: progress, messages, errors. On stderr, so that stdout is free for data.

use std::io::{self, IsTerminal as _, Write};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use anyhow::Context as _;
use indicatif::{MultiProgress, ProgressBar, ProgressStyle};
use tracing_subscriber::EnvFilter;
use tracing_subscriber::fmt::MakeWriter;

use crate::cli::context::Globals;
use crate::progress::Progress;
use crate::time::{Clock as _, MonotonicClock, Span, Timestamp};

/// A log file or a pipe gets a line of progress this often.
const LINE_EVERY: Span = Span(5_000_000_000);
/// A machine gets one this often.
const JSON_EVERY: Span = Span(500_000_000);

/// How messages are written.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum LogFormat {
    /// For people.
    #[default]
    Text,
    /// One JSON object a line.
    Json,
}

/// How progress is shown.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum ProgressMode {
    /// A bar on a terminal, else a line every few seconds.
    #[default]
    Auto,
    /// One JSON object a line, on stderr.
    Json,
    /// Not at all.
    None,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Look {
    Bar,
    Lines,
    Json,
    Nothing,
}

/// Shows progress and passes on Ctrl-C.
#[derive(Debug)]
pub struct Console {
    look: Look,
    bars: MultiProgress,
    tasks: Mutex<Vec<Task>>,
    stop: Arc<AtomicBool>,
}

#[derive(Debug)]
struct Task {
    name: String,
    total: u64,
    done: u64,
    began: Timestamp,
    told: Timestamp,
    bar: Option<ProgressBar>,
}

impl Task {
    fn per_second(&self, now: Timestamp) -> f64 {
        self.done as f64 / (now - self.began).seconds().max(1e-6)
    }

    fn seconds_left(&self, now: Timestamp) -> Option<f64> {
        (self.done > 0 && self.total > 0).then(|| self.total.saturating_sub(self.done) as f64 / self.per_second(now))
    }

    fn json(&self, event: &str, now: Timestamp) -> String {
        serde_json::json!({
            "event": event, "task": self.name, "done": self.done, "total": self.total,
            "per_second": self.per_second(now), "seconds_left": self.seconds_left(now),
        })
        .to_string()
    }

    fn line(&self, now: Timestamp) -> String {
        let left = self.seconds_left(now).map(|s| format!(", {s:.0} s left")).unwrap_or_default();
        let total = if self.total > 0 {
            format!("/{}", self.total)
        } else {
            String::new()
        };
        format!("{}: {}{total}, {:.1}/s{left}", self.name, self.done, self.per_second(now))
    }
}

impl Console {
    /// A console that shows progress in the given way; `stop` is set by Ctrl-C.
    pub fn new(mode: ProgressMode, stop: Arc<AtomicBool>) -> Self {
        let look = match mode {
            ProgressMode::Auto if io::stderr().is_terminal() => Look::Bar,
            ProgressMode::Auto => Look::Lines,
            ProgressMode::Json => Look::Json,
            ProgressMode::None => Look::Nothing,
        };
        Self {
            look,
            bars: MultiProgress::new(),
            tasks: Mutex::new(Vec::new()),
            stop,
        }
    }

    /// Send what `tracing` is told to stderr, around the bar.
    pub fn install_log(&self, globals: &Globals) -> anyhow::Result<()> {
        let level = match (globals.quiet, globals.verbose) {
            (true, _) => "error",
            (false, 0) => "info",
            (false, 1) => "debug",
            (false, _) => "trace",
        };
        let filter = EnvFilter::try_new(format!("warn,endofield={level}"))?;
        let filter = if globals.quiet { EnvFilter::try_new("error")? } else { filter };
        let writer = AroundBars(self.bars.clone());
        let log = tracing_subscriber::fmt().with_env_filter(filter).with_writer(writer);
        match globals.log_format {
            LogFormat::Json => log.json().flatten_event(true).try_init(),
            LogFormat::Text => log
                .without_time()
                .with_target(globals.verbose > 1)
                .with_ansi(io::stderr().is_terminal())
                .compact()
                .try_init(),
        }
        .map_err(|error| anyhow::anyhow!("expected to be the first to set up the log, found: {error}"))
    }

    fn say(&self, line: &str) {
        // A closed stderr must not end the work.
        let _told = writeln!(io::stderr().lock(), "{line}");
    }

    fn with_task(&self, change: impl FnOnce(&mut Task)) {
        let mut tasks = self.tasks.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(task) = tasks.last_mut() {
            change(task);
        }
    }
}

impl Progress for Console {
    fn begin(&self, task: &str, total: u64) {
        let now = MonotonicClock.now();
        let bar = (self.look == Look::Bar).then(|| {
            let bar = self.bars.add(ProgressBar::new(total));
            let template = if total > 0 {
                "{msg:28} {bar:30} {pos}/{len} · {per_sec} · {eta} left"
            } else {
                "{msg:28} {spinner} {pos} · {per_sec} · {elapsed}"
            };
            bar.set_style(ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar()));
            bar.set_message(task.to_owned());
            bar
        });
        let task = Task {
            name: task.to_owned(),
            total,
            done: 0,
            began: now,
            told: now,
            bar,
        };
        if self.look == Look::Json {
            self.say(&task.json("begin", now));
        }
        self.tasks.lock().unwrap_or_else(PoisonError::into_inner).push(task);
    }

    fn advance(&self, steps: u64) {
        self.with_task(|task| {
            task.done += steps;
            if let Some(bar) = &task.bar {
                bar.inc(steps);
                return;
            }
            let every = match self.look {
                Look::Json => JSON_EVERY,
                Look::Lines => LINE_EVERY,
                Look::Bar | Look::Nothing => return,
            };
            let now = MonotonicClock.now();
            if now - task.told >= every {
                task.told = now;
                self.say(&if self.look == Look::Json {
                    task.json("progress", now)
                } else {
                    task.line(now)
                });
            }
        });
    }

    fn end(&self) {
        let task = self.tasks.lock().unwrap_or_else(PoisonError::into_inner).pop();
        let Some(task) = task else { return };
        if let Some(bar) = &task.bar {
            bar.finish_and_clear();
            self.bars.remove(bar);
        }
        if self.look == Look::Json {
            self.say(&task.json("end", MonotonicClock.now()));
        }
    }

    fn stopping(&self) -> bool {
        self.stop.load(Ordering::Acquire)
    }
}

/// How something goes on that has no end of its own: a line rewritten in place on a terminal, else a line now and then.
#[derive(Debug)]
pub struct LiveLine<'a> {
    console: &'a Console,
    bar: Option<ProgressBar>,
    told: Option<Timestamp>,
}

impl Console {
    /// A line that is rewritten until it is dropped.
    pub fn live_line(&self) -> LiveLine<'_> {
        let bar = (self.look == Look::Bar).then(|| {
            let bar = self.bars.add(ProgressBar::new_spinner());
            bar.set_style(ProgressStyle::with_template("{wide_msg}").unwrap_or_else(|_| ProgressStyle::default_spinner()));
            bar
        });
        LiveLine {
            console: self,
            bar,
            told: None,
        }
    }
}

impl LiveLine<'_> {
    /// The present state, as text for people and as JSON for machines; may be called as often as one likes.
    pub fn update(&mut self, text: impl FnOnce() -> String, json: impl FnOnce() -> serde_json::Value) {
        if let Some(bar) = &self.bar {
            bar.set_message(text());
            return;
        }
        let every = match self.console.look {
            Look::Json => JSON_EVERY,
            Look::Lines => LINE_EVERY,
            Look::Bar | Look::Nothing => return,
        };
        let now = MonotonicClock.now();
        if self.told.is_none_or(|told| now - told >= every) {
            self.told = Some(now);
            self.console.say(&if self.console.look == Look::Json {
                json().to_string()
            } else {
                text()
            });
        }
    }

    /// The last state, for machines; people are told otherwise.
    pub fn last(&mut self, json: impl FnOnce() -> serde_json::Value) {
        if self.console.look == Look::Json {
            self.console.say(&json().to_string());
        }
    }
}

impl Drop for LiveLine<'_> {
    fn drop(&mut self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
            self.console.bars.remove(bar);
        }
    }
}

/// Writes to stderr while the bars step aside.
#[derive(Clone, Debug)]
struct AroundBars(MultiProgress);

impl Write for AroundBars {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.suspend(|| io::stderr().lock().write_all(bytes)).map(|()| bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        io::stderr().lock().flush()
    }
}

impl MakeWriter<'_> for AroundBars {
    type Writer = Self;
    fn make_writer(&self) -> Self {
        self.clone()
    }
}

/// Write a result to stdout.
pub fn print(text: &str) -> anyhow::Result<()> {
    io::stdout()
        .lock()
        .write_all(text.as_bytes())
        .context("expected to write to stdout")
}

/// Tell an error and what is behind it, as one line.
pub fn print_error(error: &anyhow::Error) {
    let _told = writeln!(io::stderr().lock(), "error: {}", chain_text(error));
}

/// The whole chain of causes; a cause that the message before it already tells is left out.
fn chain_text(error: &anyhow::Error) -> String {
    let mut text = String::new();
    for cause in error.chain() {
        let cause = cause.to_string();
        if text.is_empty() {
            text = cause;
        } else if !text.contains(&cause) {
            text = format!("{text}: {cause}");
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_chain_is_told_once() {
        let inner = anyhow::anyhow!("no such file");
        let outer = inner
            .context("cannot open video.mp4: no such file")
            .context("reading the recording");
        assert_eq!(
            chain_text(&outer),
            "reading the recording: cannot open video.mp4: no such file"
        );
    }

    #[test]
    fn a_task_tells_its_speed_and_time_left() {
        let task = Task {
            name: "process".into(),
            total: 100,
            done: 25,
            began: Timestamp(0),
            told: Timestamp(0),
            bar: None,
        };
        let now = Timestamp::from_seconds(5.0);
        assert_eq!(task.line(now), "process: 25/100, 5.0/s, 15 s left");
        let json: serde_json::Value = serde_json::from_str(&task.json("progress", now)).unwrap();
        assert_eq!(json["seconds_left"], 15.0);
    }
}
