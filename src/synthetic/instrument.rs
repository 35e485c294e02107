//! A grasper: a steel shaft through a second trocar and two jaws that open and close, casting a shadow.

use nalgebra::Vector3;

/// A rod with round ends; all in one space, mm.
#[derive(Clone, Copy, Debug)]
pub struct Rod {
    /// One end of the axis.
    pub from: Vector3<f64>,
    /// The other end.
    pub to: Vector3<f64>,
    /// Radius, mm.
    pub radius_mm: f64,
    /// Share of the light that the surface's finish keeps: 1 polished, less for the coated shaft.
    pub finish: f64,
}

/// Where a ray meets the instrument.
#[derive(Clone, Copy, Debug)]
pub struct InstrumentHit {
    /// Ray parameter.
    pub t: f64,
    /// Unit normal.
    pub normal: Vector3<f64>,
    /// See [`Rod::finish`], darkened in the grooves.
    pub finish: f64,
}

/// The second trocar in the organs' space, mm.
const TROCAR_MM: [f64; 3] = [88.0, 46.0, 96.0];

/// The instrument's rods at `seconds`, in the organs' space; it comes in, sweeps across the field, and goes.
pub fn grasper(seconds: f64) -> [Rod; 3] {
    let trocar = Vector3::from(TROCAR_MM);
    let phase = 0.9 * seconds;
    let tip = Vector3::new(
        8.0 + 22.0 * (phase + 0.3).cos(),
        8.0 + 11.0 * (0.8 * phase + 0.5).sin(),
        13.5 + 2.0 * (1.3 * phase).sin(),
    );
    let along = (tip - trocar).normalize();
    let side = along.cross(&Vector3::z()).normalize();
    let opening = 0.10 + 0.14 * (0.5 + 0.5 * (1.7 * phase).sin());
    let hinge = tip - along * 15.0;
    let jaw = |sign: f64| Rod {
        from: hinge,
        to: hinge + (along * opening.cos() + side * (sign * opening.sin())) * 15.0,
        radius_mm: 1.15,
        finish: 1.0,
    };
    [
        Rod {
            from: trocar - along * 20.0,
            to: hinge,
            radius_mm: 2.5,
            finish: 0.45,
        },
        jaw(1.0),
        jaw(-1.0),
    ]
}

/// The nearest meeting of the ray with any rod.
pub fn instrument_hit(rods: &[Rod], origin: Vector3<f64>, direction: Vector3<f64>) -> Option<InstrumentHit> {
    let mut nearest: Option<InstrumentHit> = None;
    for rod in rods {
        if let Some(t) = rod_hit(rod, origin, direction)
            && nearest.is_none_or(|hit| t < hit.t)
        {
            let at = origin + direction * t;
            let axis = rod.to - rod.from;
            let along = ((at - rod.from).dot(&axis) / axis.norm_squared()).clamp(0.0, 1.0);
            let normal = (at - rod.from - axis * along) / rod.radius_mm;
            // Turned rings on the shaft's end, serrations on the jaws.
            let from_end_mm = (1.0 - along) * axis.norm();
            let groove = if from_end_mm < 14.0 {
                0.78 + 0.22 * (from_end_mm * 4.2).sin()
            } else {
                1.0
            };
            nearest = Some(InstrumentHit {
                t,
                normal: normal.normalize(),
                finish: rod.finish * groove,
            });
        }
    }
    nearest
}

/// Ray against rod (cylinder with spherical ends), first meeting with t > 0.
fn rod_hit(rod: &Rod, origin: Vector3<f64>, direction: Vector3<f64>) -> Option<f64> {
    let axis = rod.to - rod.from;
    let offset = origin - rod.from;
    let (aa, ad, ao) = (axis.norm_squared(), axis.dot(&direction), axis.dot(&offset));
    let (dd, od, oo) = (direction.norm_squared(), offset.dot(&direction), offset.norm_squared());
    let r2 = rod.radius_mm * rod.radius_mm;
    // Distance from the axis's line equal to the radius: a quadratic in t.
    let a = aa * dd - ad * ad;
    let b = aa * od - ao * ad;
    let c = aa * oo - ao * ao - r2 * aa;
    let inside = b * b - a * c;
    if inside < 0.0 {
        return None;
    }
    if a > 1e-12 {
        let t = (-b - inside.sqrt()) / a;
        let along = ao + t * ad;
        if along > 0.0 && along < aa {
            return (t > 0.0).then_some(t);
        }
    }
    // Beyond the ends: the nearer of the two balls.
    let ball = |centre: Vector3<f64>| {
        let offset = origin - centre;
        let b = offset.dot(&direction);
        let inside = b * b - dd * (offset.norm_squared() - r2);
        (inside >= 0.0).then(|| (-b - inside.sqrt()) / dd).filter(|&t| t > 0.0)
    };
    match (ball(rod.from), ball(rod.to)) {
        (Some(a), Some(b)) => Some(a.min(b)),
        (a, b) => a.or(b),
    }
}

/// How much of a lamp of about 1.5 mm is seen from `at`, 0–1: a soft edge as wide as the lamp's image behind the rod.
pub fn unshaded(rods: &[Rod], at: Vector3<f64>, lamp: Vector3<f64>) -> f64 {
    const LAMP_RADIUS_MM: f64 = 1.5;
    let mut share = 1.0_f64;
    for rod in rods {
        let (distance, along) = distance_of_segments(at, lamp, rod.from, rod.to);
        // The penumbra's width where the rod is: the lamp shrinks towards the lit point.
        let soft = LAMP_RADIUS_MM * along + 0.15;
        share = share.min(((distance - rod.radius_mm + soft) / (2.0 * soft)).clamp(0.0, 1.0));
    }
    share
}

/// Shortest distance of the segments p–q and r–s, and where on p–q (0–1) it is (Ericson 2005, ch. 5.1.9).
fn distance_of_segments(p: Vector3<f64>, q: Vector3<f64>, r: Vector3<f64>, s: Vector3<f64>) -> (f64, f64) {
    let (d1, d2, between) = (q - p, s - r, p - r);
    let (a, e, f) = (d1.norm_squared(), d2.norm_squared(), d2.dot(&between));
    let (b, c) = (d1.dot(&d2), d1.dot(&between));
    let parallel = a * e - b * b;
    let mut u = if parallel > 1e-12 {
        ((b * f - c * e) / parallel).clamp(0.0, 1.0)
    } else {
        0.0
    };
    let mut v = (b * u + f) / e;
    if v < 0.0 {
        v = 0.0;
        u = (-c / a).clamp(0.0, 1.0);
    } else if v > 1.0 {
        v = 1.0;
        u = ((b - c) / a).clamp(0.0, 1.0);
    }
    ((p + d1 * u - r - d2 * v).norm(), u)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ray_meets_the_shaft_at_its_radius() {
        let rod = Rod {
            from: Vector3::new(-50.0, 0.0, 0.0),
            to: Vector3::new(50.0, 0.0, 0.0),
            radius_mm: 2.5,
            finish: 1.0,
        };
        let hit = instrument_hit(&[rod], Vector3::new(-10.0, 0.0, 60.0), Vector3::new(0.1, 0.0, -1.0)).unwrap();
        assert!((hit.t - 57.5).abs() < 1e-9);
        assert!((hit.normal - Vector3::z()).norm() < 1e-9);
        assert!(instrument_hit(&[rod], Vector3::new(0.0, 2.6, 60.0), -Vector3::z()).is_none());
        // The round end.
        let end = instrument_hit(&[rod], Vector3::new(51.5, 0.0, 60.0), -Vector3::z()).unwrap();
        assert!((end.t - 58.0).abs() < 1e-9);
    }

    #[test]
    fn the_shadow_lies_behind_the_rod_only() {
        let rod = Rod {
            from: Vector3::new(-50.0, 0.0, 20.0),
            to: Vector3::new(50.0, 0.0, 20.0),
            radius_mm: 2.5,
            finish: 1.0,
        };
        let lamp = Vector3::new(0.0, 0.0, 80.0);
        assert_eq!(unshaded(&[rod], Vector3::zeros(), lamp), 0.0);
        assert_eq!(unshaded(&[rod], Vector3::new(0.0, 9.0, 0.0), lamp), 1.0);
        assert_eq!(unshaded(&[rod], Vector3::new(0.0, 0.0, 30.0), lamp), 1.0);
    }
}
