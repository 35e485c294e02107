//! Switches thrown while the line runs: bypass and strength, per stage.
//!
//! They are atomics, read by a stage's thread once per frame; whoever holds the [`Controls`] may throw them from any thread.

use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};

/// The switches of one stage.
pub struct Switch {
    stage: &'static str,
    bypass: AtomicBool,
    strength_bits: AtomicU32,
}

impl std::fmt::Debug for Switch {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Switch")
            .field("stage", &self.stage)
            .field("bypass", &self.bypass)
            .field("strength", &self.strength())
            .finish_non_exhaustive()
    }
}

impl Switch {
    fn new(stage: &'static str) -> Self {
        Self {
            stage,
            bypass: AtomicBool::new(false),
            strength_bits: AtomicU32::new(NOT_SET),
        }
    }

    /// True when the stage is to be passed by.
    pub fn is_bypassed(&self) -> bool {
        self.bypass.load(Ordering::Relaxed)
    }

    /// How much of the stage's effect is wanted, 0–1; `None` while the stage's own setting holds.
    pub fn strength(&self) -> Option<f32> {
        let bits = self.strength_bits.load(Ordering::Relaxed);
        (bits != NOT_SET).then(|| f32::from_bits(bits))
    }
}

/// A NaN's bits, which no strength has.
const NOT_SET: u32 = u32::MAX;

/// A stage of that name is not in the line.
#[derive(Debug, thiserror::Error, PartialEq, Eq)]
#[error("expected the name of a stage of this line ({known}), found `{found}`")]
pub struct UnknownStage {
    /// What was asked for.
    pub found: String,
    /// What there is.
    pub known: String,
}

/// The switches of all stages, in the order of the line.
#[derive(Debug, Default)]
pub struct Controls {
    switches: Vec<Switch>,
}

impl Controls {
    pub(crate) fn for_stages(names: impl IntoIterator<Item = &'static str>) -> Self {
        Self {
            switches: names.into_iter().map(Switch::new).collect(),
        }
    }

    /// The stages' names, in the order of the line.
    pub fn stages(&self) -> impl Iterator<Item = &'static str> {
        self.switches.iter().map(|switch| switch.stage)
    }

    /// The switches of the stage at `position` in the line.
    pub fn switch(&self, position: usize) -> Option<&Switch> {
        self.switches.get(position)
    }

    fn named(&self, stage: &str) -> Result<&Switch, UnknownStage> {
        self.switches
            .iter()
            .find(|switch| switch.stage == stage)
            .ok_or_else(|| UnknownStage {
                found: stage.to_owned(),
                known: self.stages().collect::<Vec<_>>().join(", "),
            })
    }

    /// Let frames pass `stage` unaltered from now on. Its history is forgotten when it is taken in again.
    pub fn bypass(&self, stage: &str) -> Result<(), UnknownStage> {
        self.named(stage)?.bypass.store(true, Ordering::Relaxed);
        Ok(())
    }

    /// Take `stage` in again.
    pub fn resume(&self, stage: &str) -> Result<(), UnknownStage> {
        self.named(stage)?.bypass.store(false, Ordering::Relaxed);
        Ok(())
    }

    /// True when the stage at `position` is to be passed by.
    pub(super) fn is_bypassed(&self, position: usize) -> bool {
        self.switch(position).is_some_and(Switch::is_bypassed)
    }

    /// Want so much of the stage's effect; clamped to 0–1.
    pub fn set_strength(&self, stage: &str, strength: f32) -> Result<(), UnknownStage> {
        let strength = if strength.is_nan() { 0.0 } else { strength.clamp(0.0, 1.0) };
        self.named(stage)?.strength_bits.store(strength.to_bits(), Ordering::Relaxed);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn switches_are_thrown_by_name() {
        let controls = Controls::for_stages(["one", "two"]);
        controls.bypass("two").unwrap();
        controls.set_strength("one", 2.0).unwrap();
        assert!(!controls.switch(0).unwrap().is_bypassed() && controls.switch(1).unwrap().is_bypassed());
        assert_eq!(controls.switch(0).unwrap().strength(), Some(1.0));
        assert_eq!(controls.switch(1).unwrap().strength(), None);
        controls.resume("two").unwrap();
        assert!(!controls.switch(1).unwrap().is_bypassed());
    }

    #[test]
    fn an_unknown_stage_is_named_with_the_known_ones() {
        let message = Controls::for_stages(["one", "two"]).bypass("three").unwrap_err().to_string();
        assert!(message.contains("one, two") && message.contains("three"), "{message}");
    }
}
