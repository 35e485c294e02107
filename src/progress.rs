//! How long work is going: what a command shows as a bar, and where it asks whether the user has had enough.

/// Told how far a piece of work has come.
pub trait Progress: Sync {
    /// A new piece of work of `total` steps begins.
    fn begin(&self, task: &str, total: u64);
    /// So many more steps are done.
    fn advance(&self, steps: u64);
    /// The piece of work is done.
    fn end(&self);
    /// True once the user asked to stop (Ctrl-C); long loops look and leave.
    fn stopping(&self) -> bool {
        false
    }
}

/// Shows nothing.
#[derive(Clone, Copy, Debug, Default)]
pub struct Silent;

impl Progress for Silent {
    fn begin(&self, _task: &str, _total: u64) {}
    fn advance(&self, _steps: u64) {}
    fn end(&self) {}
}
