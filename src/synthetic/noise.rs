//! Coherent noise: reproducible randomness that varies smoothly in space.
//!
//! Gradient noise on the integer lattice (Perlin, "Improving noise", 2002, DOI 10.1145/566654.566636) with an integer hash
//! instead of a permutation table, so that every seed is another, equally good, field. Values lie in about −1…1, one wave a unit.

use nalgebra::Vector3;

/// A noise field of its own for each seed.
#[derive(Clone, Copy, Debug)]
pub struct Noise {
    seed: u32,
}

impl Noise {
    /// The field of a seed.
    pub fn new(seed: u64) -> Self {
        Self {
            seed: hash_u64(seed) as u32,
        }
    }

    /// One octave at `p`.
    pub fn at(&self, p: Vector3<f64>) -> f64 {
        let (ix, iy, iz) = (floor(p.x), floor(p.y), floor(p.z));
        let (x, y, z) = (p.x - f64::from(ix), p.y - f64::from(iy), p.z - f64::from(iz));
        let (u, v, w) = (fade(x), fade(y), fade(z));
        let corner = |dx: i32, dy: i32, dz: i32| {
            let hash = self.hash(ix.wrapping_add(dx), iy.wrapping_add(dy), iz.wrapping_add(dz));
            slope(hash, x - f64::from(dx), y - f64::from(dy), z - f64::from(dz))
        };
        let near = lerp(
            v,
            lerp(u, corner(0, 0, 0), corner(1, 0, 0)),
            lerp(u, corner(0, 1, 0), corner(1, 1, 0)),
        );
        let far = lerp(
            v,
            lerp(u, corner(0, 0, 1), corner(1, 0, 1)),
            lerp(u, corner(0, 1, 1), corner(1, 1, 1)),
        );
        lerp(w, near, far)
    }

    /// `octaves` octaves, each of twice the frequency and half the amplitude of the one before.
    pub fn octaves(&self, p: Vector3<f64>, octaves: u32) -> f64 {
        let (mut sum, mut amplitude, mut place) = (0.0, 1.0, p);
        for _ in 0..octaves {
            sum += amplitude * self.at(place);
            amplitude *= 0.5;
            // A shift keeps the lattice points of the octaves from coinciding, where gradient noise is always zero.
            place = place * 2.0 + Vector3::new(17.17, 5.31, 9.73);
        }
        sum
    }

    fn hash(&self, x: i32, y: i32, z: i32) -> u32 {
        let mut h = self.seed ^ (x as u32).wrapping_mul(0x9E37_79B1);
        h = (h ^ (h >> 15))
            .wrapping_add((y as u32).wrapping_mul(0x85EB_CA77))
            .wrapping_mul(0x2C1B_3C6D);
        h = (h ^ (h >> 13))
            .wrapping_add((z as u32).wrapping_mul(0xC2B2_AE3D))
            .wrapping_mul(0x297A_2D39);
        h ^ (h >> 16)
    }
}

fn fade(t: f64) -> f64 {
    t * t * t * (t * (t * 6.0 - 15.0) + 10.0)
}

fn lerp(t: f64, a: f64, b: f64) -> f64 {
    a + t * (b - a)
}

/// Rounded down; `f64::floor` is a call where the processor's newer instructions are not taken for granted.
fn floor(v: f64) -> i32 {
    let cut = v as i32;
    cut - i32::from(v < f64::from(cut))
}

/// The twelve edge directions of a cube, four of them twice.
const DIRECTIONS: [[f64; 3]; 16] = [
    [1.0, 1.0, 0.0],
    [-1.0, 1.0, 0.0],
    [1.0, -1.0, 0.0],
    [-1.0, -1.0, 0.0],
    [1.0, 0.0, 1.0],
    [-1.0, 0.0, 1.0],
    [1.0, 0.0, -1.0],
    [-1.0, 0.0, -1.0],
    [0.0, 1.0, 1.0],
    [0.0, -1.0, 1.0],
    [0.0, 1.0, -1.0],
    [0.0, -1.0, -1.0],
    [1.0, 1.0, 0.0],
    [-1.0, 1.0, 0.0],
    [0.0, -1.0, 1.0],
    [0.0, -1.0, -1.0],
];

fn slope(hash: u32, x: f64, y: f64, z: f64) -> f64 {
    let d = &DIRECTIONS[(hash & 15) as usize];
    d[0] * x + d[1] * y + d[2] * z
}

/// SplitMix64's finalizer (Steele et al. 2014): every bit of the result depends on every bit of `value`.
pub fn hash_u64(value: u64) -> u64 {
    let mut z = value.wrapping_add(0x9E37_79B9_7F4A_7C15);
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_is_centred_bounded_and_differs_by_seed() {
        let (a, b) = (Noise::new(1), Noise::new(2));
        let (mut sum, mut differing) = (0.0, 0);
        for i in 0..4000 {
            let p = Vector3::new(f64::from(i) * 0.37, f64::from(i % 61) * 0.29, f64::from(i % 17) * 0.41);
            let value = a.at(p);
            assert!(value.abs() <= 1.2, "{value}");
            sum += value;
            differing += u32::from((value - b.at(p)).abs() > 1e-3);
        }
        assert!((sum / 4000.0).abs() < 0.03, "mean {}", sum / 4000.0);
        assert!(differing > 3500);
    }
}
