//! Watches a live line: hands out what is overdue, and finds stages that hang.

use std::sync::{Arc, Weak};
use std::time::Duration;

use crossbeam::channel::{Receiver, RecvTimeoutError};

use crate::pipeline::gate::Gate;
use crate::pipeline::ledger::Ledger;
use crate::pipeline::live::Limits;
use crate::pipeline::seat::Seat;
use crate::time::{Clock, Timestamp};

/// While a frame is under way, stages are looked at this often.
const LOOK_EVERY: Duration = Duration::from_millis(10);
/// While none is, only the end of the line is waited for.
const IDLE: Duration = Duration::from_millis(500);

#[derive(Clone)]
pub(super) struct Watchdog {
    /// Not held: the gate's end is the line's.
    pub(super) gate: Weak<Gate>,
    pub(super) ledger: Arc<Ledger>,
    pub(super) seats: Arc<[Arc<Seat>]>,
    pub(super) limits: Limits,
    pub(super) clock: Arc<dyn Clock>,
}

impl Watchdog {
    /// Until the line has ended.
    pub(super) fn run(&self, wake: &Receiver<()>) {
        loop {
            let Some(next) = self.look() else { return };
            let patience = next.map_or(IDLE, |due| {
                let left = u64::try_from((due - self.clock.now()).0).unwrap_or(0);
                Duration::from_nanos(left).min(LOOK_EVERY)
            });
            if wake.recv_timeout(patience) == Err(RecvTimeoutError::Disconnected) {
                return;
            }
        }
    }

    /// Look once; when the next frame is due, and `None` when the line has ended.
    pub(super) fn look(&self) -> Option<Option<Timestamp>> {
        let gate = self.gate.upgrade()?;
        let now = self.clock.now();
        let next = gate.rescue(now);
        for seat in self.seats.iter() {
            seat.look(&self.ledger, now, self.limits.hang);
        }
        Some(next)
    }
}
