//! What each thread of the line does: the source's, a stage's, a sink's.

pub(super) mod left;
pub(super) mod sink;
pub(super) mod source;
pub(super) mod stage;
