//! The line's end: hands finished frames to the sinks, in order, and in a live line the untouched picture of one that is overdue.
//!
//! A live line gives the gate a copy of each frame's untouched picture before the first stage sees it. Whatever happens to the frame
//! in the line (a stage that hangs, a queue that drops it), at its deadline the copy is handed out in its place. So every frame that
//! entered comes out once, enhanced or as it came, unless a later one was quicker.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use crossbeam::channel;

use crate::frame::Frame;
use crate::pipeline::ledger::Ledger;
use crate::pipeline::queue::{Closed, Sender};
use crate::time::{Clock, Timestamp};

/// A finished frame on its way to a sink, with the instant at which it was handed out.
pub(super) type Handed = (Arc<Frame>, Timestamp);

/// A frame that has not come out yet.
struct Pending {
    due: Timestamp,
    untouched: Arc<Frame>,
}

struct Waiting {
    doors: Vec<Sender<Handed>>,
    pending: VecDeque<Pending>,
}

/// Where all ways through the line end. When the last of them is gone, what still waits goes out, and the sinks end.
pub(super) struct Gate {
    waiting: Mutex<Waiting>,
    ledger: Arc<Ledger>,
    clock: Arc<dyn Clock>,
    /// Tells the watchdog that there is something to watch, and when there is nothing more.
    wake: channel::Sender<()>,
}

impl Gate {
    pub(super) fn new(doors: Vec<Sender<Handed>>, ledger: Arc<Ledger>, clock: Arc<dyn Clock>, wake: channel::Sender<()>) -> Self {
        Self {
            waiting: Mutex::new(Waiting {
                doors,
                pending: VecDeque::new(),
            }),
            ledger,
            clock,
            wake,
        }
    }

    fn waiting(&self) -> MutexGuard<'_, Waiting> {
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A frame enters the line; at `due` this picture goes out in its place.
    pub(super) fn expect(&self, untouched: Arc<Frame>, due: Timestamp) {
        let mut waiting = self.waiting();
        waiting.pending.push_back(Pending { due, untouched });
        if waiting.pending.len() == 1 {
            // A full channel means that the watchdog is called already.
            let _called = self.wake.try_send(());
        }
    }

    /// A frame has come to the end.
    pub(super) fn pass(&self, frame: Frame) -> Result<(), Closed> {
        let mut waiting = self.waiting();
        let mut awaited = false;
        while waiting.pending.front().is_some_and(|first| first.untouched.id <= frame.id) {
            let first = waiting.pending.pop_front();
            awaited = first.is_some_and(|first| first.untouched.id == frame.id);
            self.ledger.count(|passed| passed.overtaken += u64::from(!awaited));
        }
        if !awaited && self.ledger.is_beyond(frame.id) {
            self.ledger.count(|passed| passed.late += 1);
            return Ok(());
        }
        if awaited {
            self.ledger.set_out(frame.id);
        }
        self.hand_out(&mut waiting, Arc::new(frame))
    }

    fn hand_out(&self, waiting: &mut Waiting, frame: Arc<Frame>) -> Result<(), Closed> {
        let now = self.clock.now();
        self.ledger.record(now - frame.arrived_at);
        waiting.doors.retain(|door| door.push((Arc::clone(&frame), now)).is_ok());
        // Who sees the count finds the frame at the sinks.
        self.ledger.count(|passed| passed.out += 1);
        if waiting.doors.is_empty() { Err(Closed) } else { Ok(()) }
    }

    /// Hand out what is overdue; when the next frame will be.
    pub(super) fn rescue(&self, now: Timestamp) -> Option<Timestamp> {
        let mut waiting = self.waiting();
        while waiting.pending.front().is_some_and(|first| first.due <= now) {
            self.rescue_first(&mut waiting);
        }
        waiting.pending.front().map(|first| first.due)
    }

    fn rescue_first(&self, waiting: &mut Waiting) {
        if let Some(first) = waiting.pending.pop_front() {
            self.ledger.set_out(first.untouched.id);
            self.ledger.count(|passed| passed.rescued += 1);
            // Closed sinks are found by whoever still works in the line.
            let _closed = self.hand_out(waiting, first.untouched);
        }
    }
}

impl Drop for Gate {
    fn drop(&mut self) {
        let mut waiting = self.waiting();
        while !waiting.pending.is_empty() {
            self.rescue_first(&mut waiting);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frame::FrameId;
    use crate::image::pool::Pool;
    use crate::pipeline::queue::{Queue, Receiver};
    use crate::time::{ManualClock, Span};

    fn frame(number: u64) -> Frame {
        Frame::new(FrameId(number), Timestamp(0), Timestamp(0), Pool::new(1).take(2, 2))
    }

    fn untouched(number: u64) -> Arc<Frame> {
        let mut frame = frame(number);
        frame.untouched = true;
        Arc::new(frame)
    }

    fn gate() -> (Gate, Arc<Ledger>, Arc<ManualClock>, Receiver<Handed>) {
        let (sender, receiver) = Queue::drop_oldest(16).open();
        let clock = Arc::new(ManualClock::default());
        let (wake, _) = channel::bounded(1);
        let ledger = Arc::new(Ledger::default());
        let gate = Gate::new(vec![sender], Arc::clone(&ledger), Arc::clone(&clock) as Arc<dyn Clock>, wake);
        (gate, ledger, clock, receiver)
    }

    fn seen(receiver: &Receiver<Handed>) -> Vec<(u64, bool)> {
        std::iter::from_fn(|| receiver.try_pop())
            .map(|(frame, _)| (frame.id.0, frame.untouched))
            .collect()
    }

    #[test]
    fn the_overdue_go_out_as_they_came_and_only_once() {
        let (gate, ledger, clock, receiver) = gate();
        for number in 0..3 {
            gate.expect(untouched(number), Timestamp(40_000_000 + 10_000_000 * number as i64));
        }
        gate.pass(frame(0)).unwrap();
        clock.advance(Span::from_milliseconds(55.0));
        assert_eq!(gate.rescue(clock.now()), Some(Timestamp(60_000_000)));
        assert!(ledger.is_beyond(FrameId(1)) && !ledger.is_beyond(FrameId(2)));
        gate.pass(frame(1)).unwrap();
        gate.pass(frame(2)).unwrap();
        assert_eq!(seen(&receiver), [(0, false), (1, true), (2, false)]);
        let passed = ledger.passed();
        assert_eq!((passed.out, passed.rescued, passed.overtaken, passed.late), (3, 1, 0, 1));
    }

    #[test]
    fn a_quicker_frame_overtakes_and_the_end_brings_what_still_waits() {
        let (gate, ledger, _, receiver) = gate();
        (0..5).for_each(|number| gate.expect(untouched(number), Timestamp(1_000_000_000)));
        gate.pass(frame(2)).unwrap();
        gate.pass(frame(1)).unwrap();
        drop(gate);
        assert_eq!(seen(&receiver), [(2, false), (3, true), (4, true)]);
        let passed = ledger.passed();
        assert_eq!(passed.out + passed.overtaken, 5);
        assert_eq!((passed.rescued, passed.overtaken, passed.late), (2, 2, 1));
        assert!(receiver.pop().is_none(), "the sinks end");
    }

    #[test]
    fn a_line_that_expects_nothing_hands_on_whatever_comes() {
        let (gate, _, _, receiver) = gate();
        for number in [4, 2, 7] {
            gate.pass(frame(number)).unwrap();
        }
        assert_eq!(seen(&receiver), [(4, false), (2, false), (7, false)]);
    }
}
