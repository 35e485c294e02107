//! Looks after a live session while it runs, whoever's loop that happens in: tells how it goes, and ends it in time.

use crate::cli::console::LiveLine;
use crate::cli::context::Context;
use crate::cli::live::session::Session;
use crate::cli::live::status::{Rate, Snapshot};
use crate::progress::Progress as _;
use crate::time::{Clock as _, MonotonicClock, Timestamp};

/// Looks after a session.
pub struct Watcher<'a> {
    context: &'a Context,
    /// What is looked after.
    pub session: Session,
    live: LiveLine<'a>,
    rate: Rate,
    began: Timestamp,
    end: Option<Timestamp>,
    first_told: bool,
    /// The user wanted it to end.
    pub stopped_by_user: bool,
}

impl std::fmt::Debug for Watcher<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Watcher")
            .field("session", &self.session)
            .finish_non_exhaustive()
    }
}

impl<'a> Watcher<'a> {
    /// `began` is when the program did, `end` when it shall end by itself.
    pub fn new(context: &'a Context, session: Session, began: Timestamp, end: Option<Timestamp>) -> Self {
        Self {
            context,
            session,
            live: context.console.live_line(),
            rate: Rate::default(),
            began,
            end,
            first_told: false,
            stopped_by_user: false,
        }
    }

    /// Look once; figures for people, and `None` when the line has ended.
    pub fn look(&mut self, user_wants_to_end: bool) -> Option<String> {
        if self.session.line.has_ended() {
            return None;
        }
        let now = MonotonicClock.now();
        if !self.first_told && self.session.meter.frames() > 0 {
            self.first_told = true;
            tracing::info!(
                "first picture after {:.2} s; {}",
                (now - self.began).seconds(),
                self.session.name
            );
        }
        let snapshot = Snapshot::of(&mut self.session, &mut self.rate, now);
        self.live.update(|| snapshot.line(), || snapshot.json("progress"));
        self.stopped_by_user |= user_wants_to_end || self.context.console.stopping();
        if self.stopped_by_user || self.end.is_some_and(|end| now >= end) {
            self.session.stop();
        }
        Some(snapshot.line())
    }

    /// Until the line has ended.
    pub fn wait(&mut self) {
        while self.look(false).is_some() {
            self.session.line.wait_a_moment();
        }
    }

    /// The last word; the session goes on to whoever sums it up.
    pub fn finish(mut self) -> (Session, bool) {
        let snapshot = Snapshot::of(&mut self.session, &mut self.rate, MonotonicClock.now());
        self.live.last(|| snapshot.json("end"));
        (self.session, self.stopped_by_user)
    }
}
