//! What the surface is made of: a texture of albedo, film gloss and film slopes over the plane of the relief.
//!
//! The wet film lies on the tissue with ripples of its own; they bend only the mirror reflection, not the diffuse light.

/// What is under one place.
#[derive(Clone, Copy, Debug, Default)]
pub struct Texel {
    /// Share of light given back diffusely, linear red, green, blue.
    pub albedo: [f32; 3],
    /// How strongly the film mirrors: 0 dry, 1 wet.
    pub gloss: f32,
    /// Slopes of the film against the tissue, along x and y.
    pub film: [f32; 2],
}

/// Texels on a regular grid, read bilinearly; clamped at the border.
#[derive(Clone, Debug)]
pub struct MaterialMap {
    pitch_mm: f64,
    origin: [f64; 2],
    columns: usize,
    rows: usize,
    texels: Vec<Texel>,
}

impl MaterialMap {
    /// A grid over ±`half_width_mm` × ±`half_height_mm`, every texel as `texel` says for its column and row.
    pub fn from_texels(
        half_width_mm: f64,
        half_height_mm: f64,
        pitch_mm: f64,
        texel: impl Fn(&MaterialGrid, usize, usize) -> Texel + Sync,
    ) -> Self {
        use rayon::prelude::*;
        let grid = MaterialGrid::new(half_width_mm, half_height_mm, pitch_mm);
        let texels = (0..grid.columns * grid.rows)
            .into_par_iter()
            .map(|i| texel(&grid, i % grid.columns, i / grid.columns))
            .collect();
        Self {
            pitch_mm,
            origin: grid.origin,
            columns: grid.columns,
            rows: grid.rows,
            texels,
        }
    }

    /// The material at (x, y), mm.
    pub fn at(&self, x: f64, y: f64) -> Texel {
        let u = ((x - self.origin[0]) / self.pitch_mm).clamp(0.0, (self.columns - 2) as f64);
        let v = ((y - self.origin[1]) / self.pitch_mm).clamp(0.0, (self.rows - 2) as f64);
        let (i, j) = (u as usize, v as usize);
        let (fu, fv) = ((u - i as f64) as f32, (v - j as f64) as f32);
        let at = j * self.columns + i;
        let (a, b) = (&self.texels[at], &self.texels[at + 1]);
        let (c, d) = (&self.texels[at + self.columns], &self.texels[at + self.columns + 1]);
        let (wa, wb, wc, wd) = ((1.0 - fu) * (1.0 - fv), fu * (1.0 - fv), (1.0 - fu) * fv, fu * fv);
        let mix = |a: f32, b: f32, c: f32, d: f32| wa * a + wb * b + wc * c + wd * d;
        Texel {
            albedo: std::array::from_fn(|k| mix(a.albedo[k], b.albedo[k], c.albedo[k], d.albedo[k])),
            gloss: mix(a.gloss, b.gloss, c.gloss, d.gloss),
            film: std::array::from_fn(|k| mix(a.film[k], b.film[k], c.film[k], d.film[k])),
        }
    }
}

/// Where the texels of a map lie.
#[derive(Clone, Copy, Debug)]
pub struct MaterialGrid {
    /// Distance of neighbours, mm.
    pub pitch_mm: f64,
    /// Place of texel (0, 0), mm.
    pub origin: [f64; 2],
    /// Texels along x.
    pub columns: usize,
    /// Texels along y.
    pub rows: usize,
}

impl MaterialGrid {
    /// A grid over ±`half_width_mm` × ±`half_height_mm`.
    pub fn new(half_width_mm: f64, half_height_mm: f64, pitch_mm: f64) -> Self {
        Self {
            pitch_mm,
            origin: [-half_width_mm, -half_height_mm],
            columns: (2.0 * half_width_mm / pitch_mm).ceil() as usize + 2,
            rows: (2.0 * half_height_mm / pitch_mm).ceil() as usize + 2,
        }
    }

    /// Place of a texel, mm.
    pub fn place(&self, column: usize, row: usize) -> (f64, f64) {
        (
            self.origin[0] + column as f64 * self.pitch_mm,
            self.origin[1] + row as f64 * self.pitch_mm,
        )
    }
}
