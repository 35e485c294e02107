//! Triangle meshes as PLY files (Turk 1994): ASCII and binary little endian read, binary little endian or ASCII written.

use std::fs;
use std::io::{BufWriter, Write as _};
use std::path::Path;

use crate::geometry::mesh::Mesh;
use crate::geometry::point::Point;
use crate::light_field::error::LightFieldError;

/// How numbers stand in the file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PlyEncoding {
    /// Readable.
    Ascii,
    /// Compact.
    BinaryLittleEndian,
}

/// Writes vertices as 32-bit floats and triangles as 32-bit indices.
pub fn write<Space>(mesh: &Mesh<Space>, path: &Path, encoding: PlyEncoding) -> Result<(), LightFieldError> {
    let file = fs::File::create(path).map_err(LightFieldError::io(path))?;
    let mut out = BufWriter::new(file);
    let format = match encoding {
        PlyEncoding::Ascii => "ascii",
        PlyEncoding::BinaryLittleEndian => "binary_little_endian",
    };
    let mut written = || -> std::io::Result<()> {
        write!(
            out,
            "ply\nformat {format} 1.0\ncomment unit mm\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n\
             element face {}\nproperty list uchar int vertex_indices\nend_header\n",
            mesh.vertices.len(),
            mesh.triangles.len()
        )?;
        for vertex in &mesh.vertices {
            let p = vertex.coords.map(|v| v as f32);
            match encoding {
                PlyEncoding::Ascii => writeln!(out, "{} {} {}", p.x, p.y, p.z)?,
                PlyEncoding::BinaryLittleEndian => {
                    for v in p.iter() {
                        out.write_all(&v.to_le_bytes())?;
                    }
                }
            }
        }
        for [a, b, c] in &mesh.triangles {
            match encoding {
                PlyEncoding::Ascii => writeln!(out, "3 {a} {b} {c}")?,
                PlyEncoding::BinaryLittleEndian => {
                    out.write_all(&[3])?;
                    for i in [a, b, c] {
                        out.write_all(&i.to_le_bytes())?;
                    }
                }
            }
        }
        out.flush()
    };
    written().map_err(LightFieldError::io(path))
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Number {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Number {
    fn parse(name: &str) -> Option<Self> {
        Some(match name {
            "char" | "int8" => Self::I8,
            "uchar" | "uint8" => Self::U8,
            "short" | "int16" => Self::I16,
            "ushort" | "uint16" => Self::U16,
            "int" | "int32" => Self::I32,
            "uint" | "uint32" => Self::U32,
            "float" | "float32" => Self::F32,
            "double" | "float64" => Self::F64,
            _ => return None,
        })
    }
}

enum Property {
    Scalar { name: String, kind: Number },
    List { count: Number, kind: Number },
}

struct Element {
    name: String,
    count: usize,
    properties: Vec<Property>,
}

enum Body<'a> {
    Ascii(std::str::SplitAsciiWhitespace<'a>),
    Binary(&'a [u8]),
}

impl Body<'_> {
    fn next(&mut self, kind: Number) -> Option<f64> {
        match self {
            Self::Ascii(words) => words.next()?.parse().ok(),
            Self::Binary(bytes) => Some(match kind {
                Number::I8 => f64::from(i8::from_le_bytes(take(bytes)?)),
                Number::U8 => f64::from(u8::from_le_bytes(take(bytes)?)),
                Number::I16 => f64::from(i16::from_le_bytes(take(bytes)?)),
                Number::U16 => f64::from(u16::from_le_bytes(take(bytes)?)),
                Number::I32 => f64::from(i32::from_le_bytes(take(bytes)?)),
                Number::U32 => f64::from(u32::from_le_bytes(take(bytes)?)),
                Number::F32 => f64::from(f32::from_le_bytes(take(bytes)?)),
                Number::F64 => f64::from_le_bytes(take(bytes)?),
            }),
        }
    }
}

fn take<const N: usize>(bytes: &mut &[u8]) -> Option<[u8; N]> {
    let (head, rest) = bytes.split_first_chunk::<N>()?;
    *bytes = rest;
    Some(*head)
}

/// Reads vertices and faces (polygons become fans of triangles); colours, normals and the like are passed over.
pub fn read<Space>(path: &Path) -> Result<Mesh<Space>, LightFieldError> {
    let bytes = fs::read(path).map_err(LightFieldError::io(path))?;
    parse(&bytes).map_err(|what| LightFieldError::corrupt(path, what))
}

fn parse<Space>(bytes: &[u8]) -> Result<Mesh<Space>, String> {
    let end = b"end_header";
    let at =
        (bytes.windows(end.len()).position(|w| w == end)).ok_or("expected a PLY header, found none; export the mesh again")?;
    let header = std::str::from_utf8(&bytes[..at]).map_err(|_| "expected a PLY header in ASCII, found binary data")?;
    let line_end = bytes[at..]
        .iter()
        .position(|&b| b == b'\n')
        .ok_or("the PLY header has no end")?
        + at
        + 1;
    let mut elements: Vec<Element> = Vec::new();
    let mut ascii = None;
    if !header.starts_with("ply") {
        return Err("expected a PLY file (first line `ply`); export the mesh again".into());
    }
    for line in header.lines() {
        let words: Vec<&str> = line.split_whitespace().collect();
        let kind = |name: &str| Number::parse(name).ok_or(format!("the PLY type `{name}` is unknown"));
        match words[..] {
            ["format", "ascii", _] => ascii = Some(true),
            ["format", "binary_little_endian", _] => ascii = Some(false),
            ["format", other, ..] => return Err(format!("expected ascii or binary_little_endian, found {other}")),
            ["element", name, count] => elements.push(Element {
                name: name.to_owned(),
                count: count
                    .parse()
                    .map_err(|_| format!("expected a count of {name}, found `{count}`"))?,
                properties: Vec::new(),
            }),
            ["property", "list", count, item, _] => {
                let list = Property::List {
                    count: kind(count)?,
                    kind: kind(item)?,
                };
                elements
                    .last_mut()
                    .ok_or("a property before any element")?
                    .properties
                    .push(list);
            }
            ["property", item, name] => {
                let scalar = Property::Scalar {
                    name: name.to_owned(),
                    kind: kind(item)?,
                };
                elements
                    .last_mut()
                    .ok_or("a property before any element")?
                    .properties
                    .push(scalar);
            }
            _ => {}
        }
    }
    let mut body = match ascii.ok_or("the PLY header has no format line")? {
        true => Body::Ascii(
            std::str::from_utf8(&bytes[line_end..])
                .map_err(|_| "expected ASCII numbers")?
                .split_ascii_whitespace(),
        ),
        false => Body::Binary(&bytes[line_end..]),
    };
    let mut mesh = Mesh::default();
    for element in &elements {
        for _ in 0..element.count {
            let mut position = [f64::NAN; 3];
            let mut polygon: Vec<u32> = Vec::new();
            for property in &element.properties {
                let short = || format!("the file ends within its {} elements; copy or export it again", element.name);
                match property {
                    Property::Scalar { name, kind } => {
                        let value = body.next(*kind).ok_or_else(short)?;
                        if let Some(axis) = ["x", "y", "z"].iter().position(|n| n == name) {
                            position[axis] = value;
                        }
                    }
                    Property::List { count, kind } => {
                        let n = body.next(*count).ok_or_else(short)?;
                        polygon.clear();
                        for _ in 0..n.max(0.0) as usize {
                            polygon.push(body.next(*kind).ok_or_else(short)? as u32);
                        }
                    }
                }
            }
            match element.name.as_str() {
                "vertex" if position.iter().all(|v| v.is_finite()) => {
                    mesh.vertices.push(Point::new(position[0], position[1], position[2]));
                }
                "vertex" => return Err(format!("vertex {} has no finite x, y, z", mesh.vertices.len())),
                "face" if polygon.len() >= 3 => {
                    mesh.triangles
                        .extend(polygon.windows(2).skip(1).map(|pair| [polygon[0], pair[0], pair[1]]));
                }
                _ => {}
            }
        }
    }
    match mesh.triangles.iter().flatten().find(|&&i| i as usize >= mesh.vertices.len()) {
        Some(i) => Err(format!("a face names vertex {i} of {}", mesh.vertices.len())),
        None => Ok(mesh),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::space::World;

    fn tetrahedron() -> Mesh<World> {
        Mesh {
            vertices: vec![
                Point::new(0.0, 0.0, 0.25),
                Point::new(10.5, 0.0, 0.0),
                Point::new(0.0, -10.0, 0.0),
                Point::new(0.0, 0.0, 100.125),
            ],
            triangles: vec![[0, 1, 2], [0, 1, 3], [1, 2, 3], [0, 2, 3]],
        }
    }

    #[test]
    fn comes_back_as_written_in_both_encodings() {
        let folder = tempfile::tempdir().unwrap();
        for encoding in [PlyEncoding::Ascii, PlyEncoding::BinaryLittleEndian] {
            let path = folder.path().join("mesh.ply");
            write(&tetrahedron(), &path, encoding).unwrap();
            let back: Mesh<World> = read(&path).unwrap();
            assert_eq!(back.vertices, tetrahedron().vertices);
            assert_eq!(back.triangles, tetrahedron().triangles);
        }
    }

    #[test]
    fn extra_properties_are_passed_over_and_quads_split() {
        let text = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\nproperty uchar red\n\
                    element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0 9\n1 0 0 9\n1 1 0 9\n0 1 0 9\n4 0 1 2 3\n";
        let mesh: Mesh<World> = parse(text.as_bytes()).unwrap();
        assert_eq!(mesh.triangles, vec![[0, 1, 2], [0, 2, 3]]);
    }

    #[test]
    fn a_cut_file_is_an_error() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("mesh.ply");
        write(&tetrahedron(), &path, PlyEncoding::BinaryLittleEndian).unwrap();
        let bytes = fs::read(&path).unwrap();
        assert!(parse::<World>(&bytes[..bytes.len() - 3]).unwrap_err().contains("ends within"));
        assert!(parse::<World>(b"hello").is_err());
    }
}
