//! The line itself: sources, stages and sinks on named threads with bounded queues between. It knows no stage by name.

pub mod stage;
