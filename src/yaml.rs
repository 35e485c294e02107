//! YAML as calibration files use it: a small tree, read leniently, written plainly.
//!
//! Two dialects matter: ROS (`camera_info`) and OpenCV's FileStorage, whose first line `%YAML:1.0` is not a YAML directive and
//! whose matrices carry the tag `!!opencv-matrix`. Tags are dropped here, the mapping below them stays.

use std::fmt::Write as _;

use saphyr::{LoadableYamlNode as _, Scalar, Yaml};

/// Why a text is not YAML.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("line {line}: {what}")]
pub struct YamlError {
    /// Counted from 1.
    pub line: usize,
    /// What the parser found.
    pub what: String,
}

/// A node of the tree.
#[derive(Clone, Debug, PartialEq)]
pub enum Node {
    /// Nothing after the key.
    Null,
    /// `true` or `false`.
    Bool(bool),
    /// Any number, also `.nan` and `.inf`.
    Number(f64),
    /// Any other scalar.
    Text(String),
    /// A sequence.
    List(Vec<Node>),
    /// A mapping in the order of the file.
    Map(Vec<(String, Node)>),
}

impl Node {
    /// The first document of `text`; an empty text is `Null`.
    pub fn parse(text: &str) -> Result<Self, YamlError> {
        // OpenCV's `%YAML:1.0` (colon, no blank) is refused by every YAML parser: blank it out, line numbers stay.
        let body = match text.strip_prefix("%YAML:") {
            Some(rest) => format!("#{rest}"),
            None => text.to_owned(),
        };
        let documents = Yaml::load_from_str(&body).map_err(|e| YamlError {
            line: e.marker().line(),
            what: e.info().to_owned(),
        })?;
        Ok(documents.first().map_or(Self::Null, Self::from_yaml))
    }

    fn from_yaml(yaml: &Yaml<'_>) -> Self {
        match yaml {
            Yaml::Value(scalar) => match scalar {
                Scalar::Null => Self::Null,
                Scalar::Boolean(value) => Self::Bool(*value),
                Scalar::Integer(value) => Self::Number(*value as f64),
                Scalar::FloatingPoint(value) => Self::Number(value.into_inner()),
                Scalar::String(value) => Self::Text(value.to_string()),
            },
            Yaml::Representation(text, ..) => Self::Text(text.to_string()),
            Yaml::Sequence(items) => Self::List(items.iter().map(Self::from_yaml).collect()),
            Yaml::Mapping(pairs) => Self::Map(
                pairs
                    .iter()
                    .map(|(key, value)| (Self::from_yaml(key).scalar_text(), Self::from_yaml(value)))
                    .collect(),
            ),
            Yaml::Tagged(_, inner) => Self::from_yaml(inner),
            Yaml::Alias(_) | Yaml::BadValue => Self::Null,
        }
    }

    /// The value of `key` in a mapping.
    pub fn get(&self, key: &str) -> Option<&Self> {
        match self {
            Self::Map(pairs) => pairs.iter().find(|(k, _)| k == key).map(|(_, value)| value),
            _ => None,
        }
    }

    /// A number, also one that is written as OpenCV writes it (`.Nan`, `-.Inf`).
    pub fn number(&self) -> Option<f64> {
        match self {
            Self::Number(value) => Some(*value),
            Self::Text(text) => text.trim().replace(".N", "N").replace(".I", "I").parse().ok(),
            _ => None,
        }
    }

    /// A text.
    pub fn text(&self) -> Option<&str> {
        match self {
            Self::Text(text) => Some(text),
            _ => None,
        }
    }

    /// All numbers of a list, nested lists taken row by row; a mapping with `data` (ROS, OpenCV) gives its data.
    pub fn numbers(&self) -> Option<Vec<f64>> {
        match self {
            Self::List(items) => {
                let mut all = Vec::with_capacity(items.len());
                for item in items {
                    match item {
                        Self::List(_) => all.extend(item.numbers()?),
                        _ => all.push(item.number()?),
                    }
                }
                Some(all)
            }
            Self::Map(_) => self.get("data")?.numbers(),
            _ => None,
        }
    }

    fn scalar_text(&self) -> String {
        match self {
            Self::Null => String::new(),
            Self::Bool(value) => value.to_string(),
            Self::Number(value) => format_number(*value),
            Self::Text(text) => text.clone(),
            Self::List(_) | Self::Map(_) => "?".to_owned(),
        }
    }

    /// Append this node as the value of `key`, indented by `indent` blanks.
    pub fn write(&self, out: &mut String, key: &str, indent: usize) {
        let blanks = " ".repeat(indent);
        // Writing to a String cannot fail.
        let _ = match self {
            Self::Map(pairs) if !pairs.is_empty() => {
                let _ = writeln!(out, "{blanks}{key}:");
                for (inner_key, value) in pairs {
                    value.write(out, inner_key, indent + 2);
                }
                Ok(())
            }
            other => writeln!(out, "{blanks}{key}: {}", other.inline()),
        };
    }

    fn inline(&self) -> String {
        match self {
            Self::Text(text) => quoted(text),
            Self::List(items) => format!("[{}]", items.iter().map(Self::inline).collect::<Vec<_>>().join(", ")),
            Self::Map(pairs) => {
                let inner: Vec<_> = pairs.iter().map(|(k, v)| format!("{k}: {}", v.inline())).collect();
                format!("{{{}}}", inner.join(", "))
            }
            other => other.scalar_text(),
        }
    }
}

/// A text that YAML reads back as this text: quoted where a plain one would be something else.
pub fn quoted(text: &str) -> String {
    let plain = !text.is_empty()
        && text.chars().all(|c| c.is_alphanumeric() || "_-./ ".contains(c))
        && text.starts_with(char::is_alphabetic)
        && !text.ends_with(' ')
        && !["true", "false", "null", "yes", "no", "on", "off", "y", "n", "nan", "inf"].contains(&text.to_lowercase().as_str());
    if plain {
        text.to_owned()
    } else {
        format!("\"{}\"", text.replace('\\', "\\\\").replace('"', "\\\"").replace('\n', "\\n"))
    }
}

/// A number with all its digits, in a form that YAML 1.1 readers (PyYAML) take for a number too: `1.0e-07`, not `1e-7`.
pub fn format_number(value: f64) -> String {
    if value.is_nan() {
        return ".nan".to_owned();
    }
    if value.is_infinite() {
        return if value > 0.0 { ".inf" } else { "-.inf" }.to_owned();
    }
    let text = format!("{value:?}");
    let Some((mantissa, exponent)) = text.split_once('e') else {
        return text;
    };
    let point = if mantissa.contains('.') { "" } else { ".0" };
    let sign = if exponent.starts_with('-') { "" } else { "+" };
    format!("{mantissa}{point}e{sign}{exponent}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn opencv_dialect_is_read() {
        let text = "%YAML:1.0\n---\nK: !!opencv-matrix\n   rows: 1\n   cols: 3\n   dt: d\n   data: [ 5.36e+02, 0., .Nan ]\n";
        let node = Node::parse(text).unwrap();
        let numbers = node.get("K").unwrap().numbers().unwrap();
        assert_eq!(numbers[..2], [536.0, 0.0]);
        assert!(numbers[2].is_nan());
    }

    #[test]
    fn an_error_names_its_line() {
        let error = Node::parse("a: 1\nb: [1, 2\nc: }\n").unwrap_err();
        assert!(error.line >= 2, "{error}");
    }

    #[test]
    fn numbers_survive_writing() {
        for value in [0.0, -1.5, 1e-7, 123_456.789, 1e22, f64::MIN_POSITIVE, 1.0 / 3.0] {
            let node = Node::parse(&format!("v: {}", format_number(value))).unwrap();
            assert_eq!(node.get("v").unwrap().number(), Some(value));
        }
    }

    #[test]
    fn a_tree_survives_writing() {
        let tree = Node::Map(vec![
            ("name".into(), Node::Text("yes".into())),
            ("note".into(), Node::Text("a \"b\": c".into())),
            (
                "inner".into(),
                Node::Map(vec![("list".into(), Node::List(vec![Node::Number(1.0), Node::Bool(true)]))]),
            ),
        ]);
        let mut text = String::new();
        tree.write(&mut text, "tree", 0);
        assert_eq!(Node::parse(&text).unwrap().get("tree"), Some(&tree));
    }
}
