//! Keeps a stage's place in a live line while what the stage needs is still being read.

use crate::frame::Frame;
use crate::pipeline::stage::{Stage, StageError};

/// Does nothing under another's name.
#[derive(Clone, Copy, Debug)]
pub struct Waiting(pub &'static str);

impl Stage for Waiting {
    fn name(&self) -> &'static str {
        self.0
    }

    fn process(&mut self, _frame: &mut Frame) -> Result<(), StageError> {
        Ok(())
    }
}
