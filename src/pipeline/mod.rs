//! The line itself: sources, stages and sinks on named threads with bounded queues between. It knows no stage by name.
//!
//! A frame's walk: `source → queue → stage → queue → stage → … → Arc → a queue per sink → sink`. Four laws hold:
//!
//! 1. **Fail open.** A stage that fails lets the frame go on as it came ([`runner`]).
//! 2. **Nothing unbounded.** Every queue has a length and says what happens when it is full ([`queue`]).
//! 3. **Time has an owner.** Only the runner reads the clock, around a stage, never in it ([`timing`]).
//! 4. **Drop at the doors, not in the hall.** Only the first queue and the sinks' queues may drop, and they count.
//!
//! A line that is [`live`] keeps a fifth: a frame that is not done at its deadline goes out as it came ([`ledger`] counts them, [`governor`] keeps stages within their time).

pub mod builder;
pub mod control;
mod gate;
pub mod governor;
pub mod ledger;
pub mod live;
pub mod outcome;
pub mod queue;
pub mod runner;
pub mod scheduling;
pub mod seat;
pub mod slot;
pub mod stage;
pub mod timing;
mod watchdog;
mod worker;
