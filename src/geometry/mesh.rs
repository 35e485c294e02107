//! A triangle mesh of a space.

use crate::geometry::point::Point;

/// Triangles over shared vertices; counter-clockwise seen from outside.
#[derive(Clone, Debug)]
pub struct Mesh<Space> {
    /// Vertices, mm.
    pub vertices: Vec<Point<Space>>,
    /// Three vertex indices a triangle.
    pub triangles: Vec<[u32; 3]>,
}

impl<Space> Default for Mesh<Space> {
    fn default() -> Self {
        Self {
            vertices: Vec::new(),
            triangles: Vec::new(),
        }
    }
}
