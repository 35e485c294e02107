//! The whole configuration: read, checked once, then never changed.
//!
//! It only gathers the rooms' own settings. `config/default.toml` holds every key with its default, its unit and why it is so.
//! What is set, from weakest to strongest: the defaults, the file of `--config`, each `--set key=value` in order.

use std::path::{Path, PathBuf};
use std::str::FromStr;

use serde::{Deserialize, Serialize};
use toml::{Table, Value};

use crate::image::{field_of_view, specularity};
use crate::light_field::prior::PriorSettings;
use crate::light_field::rolling;
use crate::pipeline::live;
use crate::pipeline::scheduling;
use crate::robot::feed;
use crate::robot::pose_buffer::{self, PoseBuffer};
use crate::sinks::virtual_camera;
use crate::sources::camera::settings as camera;
use crate::stages::{color_normalization, pose_refinement, specularity_substitution, temporal_median, undistortion};

/// One `key=value` of `--set`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Assignment {
    /// Dotted, as in `undistort.balance`.
    pub key: String,
    /// As typed.
    pub value: String,
}

impl FromStr for Assignment {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text.split_once('=') {
            Some((key, value)) if !key.trim().is_empty() => Ok(Self {
                key: key.trim().to_owned(),
                value: value.trim().to_owned(),
            }),
            _ => Err(format!("expected KEY=VALUE such as median.window_ms=200, found `{text}`")),
        }
    }
}

/// Why a configuration does not stand.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("{}: expected a configuration file, cannot read it ({reason}); check the path", path.display())]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// What the system said.
        reason: String,
    },
    /// The file says something that cannot be.
    #[error("{}: {reason}; config/default.toml lists every key with its unit and range", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// Where and what.
        reason: String,
    },
    /// A `--set` says something that cannot be.
    #[error("--set {key}={value}: {reason}; `endofield process --print-config` lists every key")]
    Set {
        /// The key.
        key: String,
        /// The value.
        value: String,
        /// What is wrong.
        reason: String,
    },
    /// A value out of bounds.
    #[error("{origin}: {reason}")]
    OutOfBounds {
        /// Where the configuration comes from.
        origin: String,
        /// Key, value and bound.
        reason: String,
    },
}

/// The line's own settings.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LineSettings {
    /// So many frames may wait between two stages, 1–64.
    pub frames_between_stages: usize,
    /// So many finished frames may wait for each writer, 1–256.
    pub frames_before_sinks: usize,
}

impl Default for LineSettings {
    fn default() -> Self {
        Self {
            frames_between_stages: 2,
            frames_before_sinks: 4,
        }
    }
}

/// How videos are written.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct OutputSettings {
    /// Constant rate factor of x264, 0–51: smaller is better and larger.
    pub crf: u8,
    /// Speed preset of x264.
    pub preset: String,
}

impl Default for OutputSettings {
    fn default() -> Self {
        Self {
            crf: 8,
            preset: "veryfast".to_owned(),
        }
    }
}

/// The whole configuration.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// The line itself.
    pub line: LineSettings,
    /// How videos are written.
    pub output: OutputSettings,
    /// How long a live picture may take.
    pub live: live::Settings,
    /// The camera of a live line.
    pub camera: camera::Settings,
    /// What other programs see of a live line.
    pub virtual_camera: virtual_camera::Settings,
    /// What the operating system is asked for.
    pub scheduling: scheduling::Settings,
    /// The temporal color median.
    pub median: temporal_median::settings::Settings,
    /// Color normalization.
    pub color: color_normalization::settings::Settings,
    /// Undistortion.
    pub undistort: undistortion::Settings,
    /// What counts as a specularity, and what as steel.
    pub specularity: specularity::Settings,
    /// How the arm is connected.
    pub arm: feed::settings::Settings,
    /// The arm's poses between its samples.
    pub poses: pose_buffer::Settings,
    /// How far a survey's poses are trusted while a light field is built.
    pub survey: PriorSettings,
    /// The light field of the video's own last frames.
    pub rolling: rolling::Settings,
    /// The arm's pose corrected by the picture.
    pub pose_refinement: pose_refinement::Settings,
    /// How specularities are replaced.
    pub substitution: specularity_substitution::settings::Settings,
    /// How the endoscope's image field is looked for.
    pub field_of_view: field_of_view::Settings,
}

impl Config {
    /// The defaults, changed by a file and then by assignments; checked.
    pub fn load(file: Option<&Path>, assignments: &[Assignment]) -> Result<Self, ConfigError> {
        let from_file = file.map(read_file).transpose()?.unwrap_or_default();
        let origin = file.map_or_else(|| "settings".to_owned(), |path| path.display().to_string());
        from_file
            .check()
            .map_err(|reason| ConfigError::OutOfBounds { origin, reason })?;
        let mut config = from_file;
        for assignment in assignments {
            config = config.with(assignment)?;
        }
        Ok(config)
    }

    /// As TOML, every key.
    pub fn to_toml(&self) -> String {
        // Every setting is a plain number, word or list, which TOML can hold.
        toml::to_string_pretty(self).unwrap_or_default()
    }

    fn with(&self, assignment: &Assignment) -> Result<Self, ConfigError> {
        let refused = |reason: String| ConfigError::Set {
            key: assignment.key.clone(),
            value: assignment.value.clone(),
            reason,
        };
        let mut tree = Table::try_from(self).map_err(|error| refused(error.to_string()))?;
        let mut place = &mut tree;
        let mut path: Vec<&str> = assignment.key.split('.').collect();
        let Some(last) = path.pop() else {
            return Err(refused("expected a key, found none".to_owned()));
        };
        for part in path {
            let known = listed(place);
            place = match place.get_mut(part) {
                Some(Value::Table(inner)) => inner,
                _ => return Err(refused(format!("expected `{part}` to be one of {known}"))),
            };
        }
        let present = place.get(last);
        if matches!(present, Some(Value::Table(_))) {
            return Err(refused(format!("expected a single setting, `{last}` is a group of them")));
        }
        let value = typed_value(&assignment.value, present).map_err(&refused)?;
        place.insert(last.to_owned(), value);
        let changed: Self = Value::Table(tree)
            .try_into()
            .map_err(|error: toml::de::Error| refused(one_line(&error)))?;
        changed.check().map_err(refused)?;
        Ok(changed)
    }

    /// What is out of bounds: key, value and bound.
    fn check(&self) -> Result<(), String> {
        let within = |key: &str, value: usize, low: usize, high: usize| {
            let fits = (low..=high).contains(&value);
            fits.then_some(())
                .ok_or_else(|| format!("{key}: expected {low} to {high}, found {value}"))
        };
        within("line.frames_between_stages", self.line.frames_between_stages, 1, 64)?;
        within("line.frames_before_sinks", self.line.frames_before_sinks, 1, 256)?;
        within("output.crf", usize::from(self.output.crf), 0, 51)?;
        self.live.check()?;
        self.camera.check()?;
        self.virtual_camera.check()?;
        self.scheduling.check()?;
        self.median.check().map_err(|error| error.to_string())?;
        self.color.check().map_err(|error| error.to_string())?;
        if let Some(balance) = self.undistort.balance.filter(|balance| !(0.0..=1.0).contains(balance)) {
            return Err(format!("undistort.balance: expected 0 to 1, found {balance}"));
        }
        PoseBuffer::new(&self.poses).map(|_| ()).map_err(|error| error.to_string())?;
        self.arm.check()?;
        self.survey.check()?;
        self.rolling.check()?;
        // Amounts, reaches and shares: none of them can be negative, and no setting at all can be infinite or no number.
        let tree = Table::try_from(self).map_err(|error| error.to_string())?;
        for (group, settings) in &tree {
            let lowest = if NEVER_NEGATIVE.contains(&group.as_str()) {
                0.0
            } else {
                f64::MIN
            };
            check_numbers(group, settings, lowest)?;
        }
        Ok(())
    }
}

/// Groups whose numbers are all amounts.
const NEVER_NEGATIVE: [&str; 3] = ["specularity", "pose_refinement", "substitution"];

fn check_numbers(key: &str, value: &Value, lowest: f64) -> Result<(), String> {
    match value {
        Value::Table(table) => table
            .iter()
            .try_for_each(|(name, inner)| check_numbers(&format!("{key}.{name}"), inner, lowest)),
        Value::Array(list) => list.iter().try_for_each(|inner| check_numbers(key, inner, lowest)),
        Value::Float(number) if !number.is_finite() => Err(format!("{key}: expected a finite number, found {number}")),
        Value::Float(number) if *number < lowest => Err(format!("{key}: expected {lowest} or more, found {number}")),
        _ => Ok(()),
    }
}

fn read_file(path: &Path) -> Result<Config, ConfigError> {
    let text = std::fs::read_to_string(path).map_err(|error| ConfigError::Unreadable {
        path: path.to_owned(),
        reason: error.to_string(),
    })?;
    toml::from_str(&text).map_err(|error| {
        let line = error
            .span()
            .map(|span| 1 + text.get(..span.start).unwrap_or("").matches('\n').count());
        let place = line.map(|line| format!("line {line}: ")).unwrap_or_default();
        ConfigError::File {
            path: path.to_owned(),
            reason: format!("{place}{}", one_line(&error)),
        }
    })
}

fn one_line(error: &toml::de::Error) -> String {
    error.message().lines().collect::<Vec<_>>().join(" ")
}

fn listed(table: &Table) -> String {
    table.keys().cloned().collect::<Vec<_>>().join(", ")
}

/// What was typed, as the kind of value that stands there now. A setting without a present value takes any kind.
fn typed_value(text: &str, present: Option<&Value>) -> Result<Value, String> {
    if matches!(present, Some(Value::String(_))) {
        let bare = text.strip_prefix('"').and_then(|rest| rest.strip_suffix('"')).unwrap_or(text);
        return Ok(Value::String(bare.to_owned()));
    }
    let parsed = toml::from_str::<Table>(&format!("v = {text}"))
        .ok()
        .and_then(|mut table| table.remove("v"));
    match (present, parsed) {
        (None, parsed) => Ok(parsed.unwrap_or_else(|| Value::String(text.to_owned()))),
        (Some(Value::Float(_)), Some(Value::Integer(whole))) => Ok(Value::Float(whole as f64)),
        (Some(now), Some(new)) if now.same_type(&new) => Ok(new),
        (Some(now), _) => Err(format!("expected {} such as {now}, found `{text}`", kind_name(now))),
    }
}

fn kind_name(value: &Value) -> &'static str {
    match value {
        Value::String(_) => "a word",
        Value::Integer(_) => "a whole number",
        Value::Float(_) => "a number",
        Value::Boolean(_) => "true or false",
        Value::Datetime(_) => "a date",
        Value::Array(_) => "a list",
        Value::Table(_) => "a group of settings",
    }
}
