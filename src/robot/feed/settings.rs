//! How the arm is connected: `[arm]` in the configuration.

use serde::{Deserialize, Serialize};

use crate::robot::feed::message::fault_bit;

/// What the arm speaks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Protocol {
    /// The binary format of `docs/arm_feed.md`.
    #[default]
    Endofield,
    /// A pose a line.
    TextPoses,
    /// Joint values a line.
    TextJoints,
}

/// Parity bit.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Parity {
    /// No bit.
    #[default]
    None,
    /// Makes the count of ones odd.
    Odd,
    /// Makes it even.
    Even,
}

/// Who may say "wait".
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FlowControl {
    /// Nobody.
    #[default]
    None,
    /// XON and XOFF. Eats two byte values: not for binary formats.
    Software,
    /// RTS and CTS.
    Hardware,
}

/// Data Terminal Ready, by which some adapters power or reset the device.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DataTerminalReady {
    /// As the system has it.
    #[default]
    Keep,
    /// Raised on opening.
    On,
    /// Lowered on opening.
    Off,
}

/// Whose time the poses carry.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PoseClock {
    /// The host's monotonic clock, as pictures do: for everything live.
    #[default]
    Host,
    /// The device's own stamps as they are: for files.
    Device,
}

/// How the arm is connected and how far it is believed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// The serial port's path; empty: no arm.
    pub port: String,
    /// What the arm speaks.
    pub protocol: Protocol,
    /// Bits a second.
    pub baud: u32,
    /// Data bits of a character, 5–8.
    pub data_bits: u8,
    /// Parity bit.
    pub parity: Parity,
    /// Stop bits, 1 or 2.
    pub stop_bits: u8,
    /// Who may say "wait".
    pub flow_control: FlowControl,
    /// Data Terminal Ready.
    pub dtr: DataTerminalReady,
    /// A file like `config/arms/aesop3000.toml`, which is what an empty path means.
    pub kinematics: String,
    /// Without a byte for so long the line counts as silent, ms, 20–60000.
    pub silence_ms: f64,
    /// How often a lost port is tried again, ms, 10–60000.
    pub reopen_ms: f64,
    /// Whose time the poses carry.
    pub clock: PoseClock,
    /// A device's clock is off by at most so much, ppm, 0–10000.
    pub max_drift_ppm: f64,
    /// Taken from every pose's time: what even the quickest message takes, ms, 0–1000.
    pub delay_ms: f64,
    /// Poses that come with any of these fault bits are refused.
    pub refused_faults: u16,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            port: String::new(),
            protocol: Protocol::Endofield,
            baud: 115_200,
            data_bits: 8,
            parity: Parity::None,
            stop_bits: 1,
            flow_control: FlowControl::None,
            dtr: DataTerminalReady::Keep,
            kinematics: String::new(),
            silence_ms: 70.0,
            reopen_ms: 100.0,
            clock: PoseClock::Host,
            max_drift_ppm: 300.0,
            delay_ms: 0.0,
            refused_faults: fault_bit::ENCODER | fault_bit::NOT_REFERENCED,
        }
    }
}

impl Settings {
    /// What is out of bounds: key, value and bound.
    pub fn check(&self) -> Result<(), String> {
        let bounds = [
            ("arm.baud", f64::from(self.baud), 50.0, 12e6),
            ("arm.data_bits", f64::from(self.data_bits), 5.0, 8.0),
            ("arm.stop_bits", f64::from(self.stop_bits), 1.0, 2.0),
            ("arm.silence_ms", self.silence_ms, 20.0, 60_000.0),
            ("arm.reopen_ms", self.reopen_ms, 10.0, 60_000.0),
            ("arm.max_drift_ppm", self.max_drift_ppm, 0.0, 10_000.0),
            ("arm.delay_ms", self.delay_ms, 0.0, 1000.0),
        ];
        for (key, found, lowest, highest) in bounds {
            if !(lowest..=highest).contains(&found) {
                return Err(format!("{key}: expected {lowest} to {highest}, found {found}"));
            }
        }
        if self.protocol == Protocol::Endofield && (self.flow_control == FlowControl::Software || self.data_bits != 8) {
            return Err(
                "arm.protocol: `endofield` is binary and needs arm.data_bits = 8 and arm.flow_control = \"none\" or \"hardware\""
                    .into(),
            );
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bounds_are_named() {
        assert_eq!(Settings::default().check(), Ok(()));
        let wrong = |change: fn(&mut Settings)| {
            let mut settings = Settings::default();
            change(&mut settings);
            settings.check().unwrap_err()
        };
        assert!(wrong(|s| s.silence_ms = f64::NAN).contains("arm.silence_ms"));
        assert!(wrong(|s| s.data_bits = 9).contains("5 to 8"));
        assert!(wrong(|s| s.flow_control = FlowControl::Software).contains("binary"));
    }
}
