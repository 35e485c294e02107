//! OpenCV's XML FileStorage, turned into the same tree as its YAML twin.
//!
//! Only what FileStorage writes is understood: elements, attributes (ignored), text and comments; no entities but the usual
//! five, no CDATA, no namespaces.

use crate::yaml::{Node, YamlError};

/// Elements may hold elements, but not endlessly: a file deeper than this is no calibration.
const DEEPEST: usize = 32;

/// The content of `<opencv_storage>`.
pub fn parse(text: &str) -> Result<Node, YamlError> {
    let mut reader = Reader { text, at: 0 };
    loop {
        let Some(tag) = reader.next_tag()? else {
            return Err(reader.error("expected <opencv_storage>, found the end of the file"));
        };
        if tag.name == "opencv_storage" {
            return reader.element("opencv_storage", 0);
        }
        if !tag.name.starts_with('?') {
            return Err(reader.error(&format!("expected <opencv_storage>, found <{}>", tag.name)));
        }
    }
}

struct Tag<'a> {
    name: &'a str,
    /// Text between the previous tag and this one.
    before: &'a str,
    closes: bool,
    empty: bool,
}

struct Reader<'a> {
    text: &'a str,
    at: usize,
}

impl<'a> Reader<'a> {
    fn error(&self, what: &str) -> YamlError {
        let line = 1 + self.text.as_bytes().iter().take(self.at).filter(|b| **b == b'\n').count();
        YamlError {
            line,
            what: what.to_owned(),
        }
    }

    fn next_tag(&mut self) -> Result<Option<Tag<'a>>, YamlError> {
        loop {
            let rest = &self.text[self.at..];
            let Some(open) = rest.find('<') else {
                return Ok(None);
            };
            let (before, tag) = (&rest[..open], &rest[open..]);
            if tag.starts_with("<!--") {
                let Some(end) = tag.find("-->") else {
                    return Err(self.error("a comment without end"));
                };
                self.at += open + end + 3;
                continue;
            }
            let Some(end) = tag.find('>') else {
                return Err(self.error("a tag without `>`"));
            };
            self.at += open + end + 1;
            let inner = &tag[1..end];
            let closes = inner.starts_with('/');
            let empty = inner.ends_with('/');
            let name = inner
                .trim_start_matches('/')
                .split([' ', '\t', '\n', '\r', '/'])
                .next()
                .unwrap_or("");
            return Ok(Some(Tag {
                name,
                before,
                closes,
                empty,
            }));
        }
    }

    /// What stands between the opening tag `name`, already read, and its closing one.
    fn element(&mut self, name: &str, depth: usize) -> Result<Node, YamlError> {
        if depth > DEEPEST {
            return Err(self.error("elements nested too deeply"));
        }
        let mut children = Vec::new();
        loop {
            let Some(tag) = self.next_tag()? else {
                return Err(self.error(&format!("<{name}> is not closed: the file is cut short")));
            };
            if !tag.closes {
                let child = if tag.empty {
                    Node::Null
                } else {
                    self.element(tag.name, depth + 1)?
                };
                children.push((tag.name.to_owned(), child));
                continue;
            }
            if tag.name != name {
                return Err(self.error(&format!("expected </{name}>, found </{}>", tag.name)));
            }
            return Ok(if children.is_empty() {
                scalar_or_list(tag.before)
            } else {
                Node::Map(children)
            });
        }
    }
}

fn scalar_or_list(text: &str) -> Node {
    let text = text.trim();
    let numbers: Option<Vec<Node>> = text
        .split_whitespace()
        .map(|word| Some(Node::Number(Node::Text(word.to_owned()).number()?)))
        .collect();
    match numbers {
        Some(mut numbers) if numbers.len() == 1 => numbers.remove(0),
        Some(numbers) if !numbers.is_empty() => Node::List(numbers),
        _ => Node::Text(text.trim_matches('"').to_owned()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_matrix_and_a_number_are_read() {
        let text = "<?xml version=\"1.0\"?>\n<opencv_storage>\n<image_Width>768</image_Width><!-- <x> -->\n<K type_id=\"opencv-matrix\">\n  \
                    <rows>1</rows><data>\n 6.5e+02 0.\n 4.2</data></K>\n</opencv_storage>\n";
        let node = parse(text).unwrap();
        assert_eq!(node.get("image_Width").unwrap().number(), Some(768.0));
        assert_eq!(node.get("K").unwrap().numbers().unwrap(), [650.0, 0.0, 4.2]);
    }

    #[test]
    fn a_file_cut_short_is_an_error() {
        assert!(parse("<?xml version=\"1.0\"?>\n<opencv_storage>\n<K><rows>1</rows>").is_err());
        assert!(parse("").is_err());
        assert!(parse("<html></html>").is_err());
    }
}
