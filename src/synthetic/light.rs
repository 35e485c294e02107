//! Light on wet tissue: the dichromatic model (Shafer 1985) with a Lambertian body and a microfacet coat.
//!
//! The lamps ride on the scope, a few mm beside the lens. The coat is GGX (Walter et al. 2007) with Schlick's Fresnel term
//! (1994, DOI 10.1111/1467-8659.1330233): a narrow lobe for the film itself and a wide, faint one for the haze around it.

use nalgebra::Vector3;

use crate::synthetic::material::Texel;

/// One lamp (a bundle of fibres) at the scope's tip.
#[derive(Clone, Copy, Debug)]
pub struct Lamp {
    /// Place in the camera's space, mm.
    pub at: Vector3<f64>,
    /// Where it points, in the camera's space, unit length.
    pub axis: Vector3<f64>,
    /// Intensity along the axis; 1 gives a white wall 75 mm away, facing it, a radiance of 1.
    pub intensity: f64,
    /// Colour, linear.
    pub colour: [f64; 3],
}

/// The film's optics.
#[derive(Clone, Copy, Debug)]
pub struct Film {
    /// Reflectance straight on; water on tissue about 0.025.
    pub f0: f64,
    /// GGX roughness α of the narrow lobe.
    pub narrow_alpha: f64,
    /// GGX roughness α of the haze.
    pub wide_alpha: f64,
    /// Share of the haze in the coat.
    pub wide_share: f64,
}

impl Default for Film {
    fn default() -> Self {
        Self {
            f0: 0.025,
            narrow_alpha: 0.045,
            wide_alpha: 0.18,
            wide_share: 0.14,
        }
    }
}

/// Light towards the camera, linear red, green, blue.
#[derive(Clone, Copy, Debug, Default)]
pub struct Radiance {
    /// From inside the tissue.
    pub diffuse: [f32; 3],
    /// Mirrored by the film.
    pub specular: [f32; 3],
}

/// Distance at which the lamps' intensity is calibrated, mm.
const REFERENCE_MM: f64 = 75.0;

/// Fall-off of a lamp to the side: cos(angle) to this power.
const SPOT_EXPONENT: i32 = 5;

/// One surface point as the light sees it; all vectors in one space.
#[derive(Clone, Copy, Debug)]
pub struct Facing {
    /// The point, mm.
    pub at: Vector3<f64>,
    /// Unit normal of the tissue.
    pub normal: Vector3<f64>,
    /// Unit normal of the film.
    pub film_normal: Vector3<f64>,
    /// Unit vector to the camera.
    pub to_camera: Vector3<f64>,
}

/// Light of one lamp that arrives: unit direction to it, and irradiance per cosine.
pub fn arriving(lamp: &Lamp, at: Vector3<f64>) -> (Vector3<f64>, f64) {
    let way = lamp.at - at;
    let squared = way.norm_squared();
    let to_lamp = way / squared.sqrt();
    let off_axis = (-to_lamp.dot(&lamp.axis)).max(0.0);
    (
        to_lamp,
        lamp.intensity * off_axis.powi(SPOT_EXPONENT) * REFERENCE_MM * REFERENCE_MM / squared,
    )
}

/// What `texel` sends to the camera under `lamps`; `shade` gives each lamp's visibility, 0–1.
pub fn tissue_radiance(facing: &Facing, texel: &Texel, lamps: &[Lamp], film: &Film, shade: impl Fn(&Lamp) -> f64) -> Radiance {
    let mut radiance = Radiance::default();
    for lamp in lamps {
        let (to_lamp, strength) = arriving(lamp, facing.at);
        let strength = strength * shade(lamp);
        if strength <= 0.0 {
            continue;
        }
        // Light that scatters under the surface wraps a little around the terminator.
        const WRAP: f64 = 0.12;
        let lit = ((facing.normal.dot(&to_lamp) + WRAP) / (1.0 + WRAP)).max(0.0) * strength;
        let mirrored = coat(facing, to_lamp, film) * strength * f64::from(texel.gloss);
        for k in 0..3 {
            radiance.diffuse[k] += texel.albedo[k] * (lit * lamp.colour[k]) as f32;
            radiance.specular[k] += (mirrored * lamp.colour[k]) as f32;
        }
    }
    radiance
}

/// Cosine-weighted reflectance of the coat, times π (the lamps are calibrated on a white wall).
fn coat(facing: &Facing, to_lamp: Vector3<f64>, film: &Film) -> f64 {
    let n_l = facing.film_normal.dot(&to_lamp);
    let n_v = facing.film_normal.dot(&facing.to_camera);
    if n_l <= 0.0 || n_v <= 0.0 {
        return 0.0;
    }
    let half = (to_lamp + facing.to_camera).normalize();
    let n_h = facing.film_normal.dot(&half);
    let fresnel = film.f0 + (1.0 - film.f0) * (1.0 - half.dot(&facing.to_camera)).max(0.0).powi(5);
    let narrow = lobe(n_h, n_l, n_v, film.narrow_alpha);
    let wide = lobe(n_h, n_l, n_v, film.wide_alpha);
    std::f64::consts::PI * fresnel * n_l * (narrow * (1.0 - film.wide_share) + wide * film.wide_share)
}

/// GGX distribution (Walter 2007, eq. 33) times shadowing over 4 n·l n·v, the latter in Schlick's form (1994, eq. 19) with
/// k = α/2, which is close to Smith's and needs no roots.
fn lobe(n_h: f64, n_l: f64, n_v: f64, alpha: f64) -> f64 {
    let a2 = alpha * alpha;
    let base = n_h * n_h * (a2 - 1.0) + 1.0;
    let k = 0.5 * alpha;
    let shadowing = 4.0 * (n_l * (1.0 - k) + k) * (n_v * (1.0 - k) + k);
    a2 / (std::f64::consts::PI * base * base * shadowing)
}

/// A steel surface: almost no body, a strong brushed coat.
pub fn steel_radiance(facing: &Facing, lamps: &[Lamp]) -> Radiance {
    const STEEL: Film = Film {
        f0: 0.55,
        narrow_alpha: 0.16,
        wide_alpha: 0.45,
        wide_share: 0.6,
    };
    let mut radiance = Radiance::default();
    for lamp in lamps {
        let (to_lamp, strength) = arriving(lamp, facing.at);
        let lit = facing.normal.dot(&to_lamp).max(0.0) * strength * 0.07;
        let mirrored = coat(facing, to_lamp, &STEEL) * strength;
        for k in 0..3 {
            const TINT: [f64; 3] = [0.97, 0.98, 1.0];
            radiance.diffuse[k] += (lit * lamp.colour[k] * TINT[k]) as f32;
            radiance.specular[k] += (mirrored * lamp.colour[k] * TINT[k]) as f32;
        }
    }
    radiance
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_coat_gives_back_no_more_than_it_gets() {
        // Directional albedo by quadrature over the hemisphere: below 1, near F0 for a smooth coat.
        let film = Film {
            f0: 1.0,
            narrow_alpha: 0.3,
            wide_alpha: 0.3,
            wide_share: 0.0,
        };
        for tilt in [0.0_f64, 0.5, 1.0] {
            let facing = Facing {
                at: Vector3::zeros(),
                normal: Vector3::z(),
                film_normal: Vector3::z(),
                to_camera: Vector3::new(tilt.sin(), 0.0, tilt.cos()),
            };
            let (steps, mut sum) = (200, 0.0);
            for i in 0..steps {
                let theta = (f64::from(i) + 0.5) / f64::from(steps) * std::f64::consts::FRAC_PI_2;
                for j in 0..2 * steps {
                    let phi = f64::from(j) / f64::from(steps) * std::f64::consts::PI;
                    let to_lamp = Vector3::new(theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos());
                    let area =
                        theta.sin() * std::f64::consts::FRAC_PI_2 / f64::from(steps) * std::f64::consts::PI / f64::from(steps);
                    sum += coat(&facing, to_lamp, &film) / std::f64::consts::PI * area;
                }
            }
            // Schlick's masking, squared, at a tilt of 1 rad: (0.54/(0.54·0.85 + 0.15))² ≈ 0.79 of what Smith's keeps (0.9).
            assert!(sum < 1.0 && sum > 0.71, "tilt {tilt}: {sum}");
        }
    }

    #[test]
    fn a_white_wall_at_the_reference_distance_shines_with_radiance_one() {
        let lamp = Lamp {
            at: Vector3::zeros(),
            axis: Vector3::z(),
            intensity: 1.0,
            colour: [1.0; 3],
        };
        let facing = Facing {
            at: Vector3::new(0.0, 0.0, REFERENCE_MM),
            normal: -Vector3::z(),
            film_normal: -Vector3::z(),
            to_camera: -Vector3::z(),
        };
        let white = Texel {
            albedo: [1.0; 3],
            gloss: 0.0,
            film: [0.0; 2],
        };
        let radiance = tissue_radiance(&facing, &white, &[lamp], &Film::default(), |_| 1.0);
        assert!((radiance.diffuse[1] - 1.0).abs() < 1e-6);
        assert_eq!(radiance.specular, [0.0; 3]);
    }
}
