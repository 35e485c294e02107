//! How much of a colour is the lamp's, given what other views show of the same place.

use crate::image::color::luma;

/// So many answers, and this share of all, must agree to be the tissue's: most of the witnesses may be dazzled themselves.
const FEWEST_AGREEING: usize = 3;
/// See [`FEWEST_AGREEING`].
const AGREEING_SHARE: f32 = 0.08;
/// So large a share of all answers is a crowd …
const CROWD_SHARE: f32 = 0.4;
/// … and tight when it differs by at most this.
const CROWD_SPREAD: f32 = 0.08;
/// A crowd that is the darker few in white light must be so large a share to be tissue all the same.
const WHITE_CROWD_SHARE: f32 = 0.75;
/// Less white light than this share of the tissue's brightness may be noise.
const LEAST_LAMP: f32 = 0.06;
/// At most this share of a change may be of another colour when the lamp is to explain it. On rendered scenes 97 % of the lamp's patches
/// have less than 0.06, three in four of others more than 0.07; lamps are not quite white.
const MOST_OTHER_SHARE: f32 = 0.075;
/// Tissue is grey where the sine of its angle to grey is below this; the lamp's change must then be grey.
const GREY_SINE: f32 = 0.1;
/// Answers agree when they differ by at most this share.
const AGREEMENT: f32 = 0.06;
/// Noise of a colour, share of its brightness.
const NOISE: f32 = 0.018;
/// How well the views' exposure and lamp are undone, share.
const LIT: f32 = 0.025;

/// What the views say of one place; keeps its memory.
#[derive(Debug, Default)]
pub struct Tissue {
    answers: Vec<(f32, [f32; 3])>,
    clipped: usize,
}

impl Tissue {
    /// Forget the last place.
    pub fn clear(&mut self) {
        self.answers.clear();
        self.clipped = 0;
    }

    /// One view shows nothing but white: it says no colour, yet it is one who looked.
    pub fn hear_clipped(&mut self) {
        self.clipped += 1;
    }

    /// One view's colour.
    pub fn hear(&mut self, color: [f32; 3]) {
        self.answers.push((darkness(color), color));
    }

    /// How many were heard.
    pub fn answers(&self) -> usize {
        self.answers.len()
    }

    /// The tissue's colour.
    ///
    /// The mean of the darkest answers that agree with each other; a dark middle one when no few agree. A tight crowd outvotes a darker
    /// few: the lamp dazzles every view differently, so what many show alike is tissue, however bright, and the few look past it. Where
    /// white light alone makes the crowd of the few, it must be nearly all: a broad lobe stays in place for many views. And where a
    /// single view saw less of the lamp than those that agree, they agree on the lamp.
    pub fn judge(&mut self) -> Verdict {
        let all = self.answers.len();
        self.answers.sort_unstable_by(|a, b| a.0.total_cmp(&b.0));
        let few = FEWEST_AGREEING.max((AGREEING_SHARE * all as f32) as usize).min(all);
        let few_at = self.agreeing(few, AGREEMENT);
        let crowd = |share: f32| (share * (all + self.clipped) as f32) as usize;
        let crowd_at = |share: f32| {
            if crowd(share) > few {
                self.agreeing(crowd(share), CROWD_SPREAD)
            } else {
                None
            }
        };
        let sure = |first: usize| Verdict {
            color: self.group(first),
            is_sure: true,
        };
        let darkest = self.answers[0].1;
        match (crowd_at(CROWD_SHARE), few_at) {
            (Some(many), few) => {
                let few = few.filter(|&few| few < many && is_under_lamp(self.group(many), self.group(few)));
                sure(few.map_or(many, |few| crowd_at(WHITE_CROWD_SHARE).unwrap_or(few)))
            }
            (None, Some(few)) if few == 0 || !is_under_lamp(self.group(few), darkest) => sure(few),
            (None, Some(_)) => Verdict {
                color: darkest,
                is_sure: false,
            },
            (None, None) => Verdict {
                color: self.answers[all / 8].1,
                is_sure: false,
            },
        }
    }

    /// Where the darkest answers begin of which so many differ by at most this share.
    fn agreeing(&self, enough: usize, spread: f32) -> Option<usize> {
        let agree = |group: &[(f32, [f32; 3])]| group[group.len() - 1].0 <= (1.0 + spread) * group[0].0;
        self.answers.windows(enough.max(1)).position(agree)
    }

    /// The mean of the answers that agree with one and are not darker.
    fn group(&self, first: usize) -> [f32; 3] {
        let answers = self.answers[first..].iter();
        let group = answers.take_while(|a| a.0 <= (1.0 + AGREEMENT) * self.answers[first].0);
        let (sum, count) = group.fold(([0.0_f32; 3], 0.0_f32), |(sum, count), (_, color)| {
            (std::array::from_fn(|c| sum[c] + color[c]), count + 1.0)
        });
        sum.map(|s| s / count)
    }
}

/// True if `bright` is `dark`, lit a little better or worse, under white light.
fn is_under_lamp(bright: [f32; 3], dark: [f32; 3]) -> bool {
    let change = std::array::from_fn(|c| bright[c] - dark[c]);
    difference(bright, dark).lamp > LEAST_LAMP && other_than_lit_and_white(change, dark) < MOST_OTHER_SHARE * length(change)
}

/// How much of `change` is neither the `tissue`'s colour nor white.
///
/// A picture that shows the lamp is, in each channel, tissue lit a little better or worse plus white light (dichromatic model, Shafer
/// 1985). What of the change lies in neither of these two directions of colour space is neither.
fn other_than_lit_and_white(change: [f32; 3], tissue: [f32; 3]) -> f32 {
    // Upright on both: tissue × (1, 1, 1).
    let upright = [tissue[1] - tissue[2], tissue[2] - tissue[0], tissue[0] - tissue[1]];
    let size = length(upright);
    if size > GREY_SINE * 3.0_f32.sqrt() * length(tissue) {
        (change[0] * upright[0] + change[1] * upright[1] + change[2] * upright[2]).abs() / size
    } else {
        let mean = (change[0] + change[1] + change[2]) / 3.0;
        length(change.map(|v| v - mean))
    }
}

/// Of a colour as a vector.
pub fn length(v: [f32; 3]) -> f32 {
    (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt()
}

/// What the views say together.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Verdict {
    /// Of the tissue; under some of the lamp's light where it is not sure.
    pub color: [f32; 3],
    /// False where the views do not agree on what is darkest: perhaps none saw it clean.
    pub is_sure: bool,
}

/// What answers are ordered by: brightness, the darkest channel twice more, since white light shows there most.
fn darkness(color: [f32; 3]) -> f32 {
    luma(color) + 2.0 * color[0].min(color[1]).min(color[2])
}

/// How a colour differs from the tissue's.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Difference {
    /// White light that the tissue has not, as a share of the tissue's brightness; negative when the colour is less white.
    pub lamp: f32,
    /// By what share it is lit better; negative when it is darker than the lamp explains.
    pub lit: f32,
}

/// color = (1 + lit)·tissue + lamp·white + noise, with `lit` small: how a place is lit is known to [`LIT`] (least squares; the dichromatic
/// model of Shafer 1985).
pub fn difference(color: [f32; 3], tissue: [f32; 3]) -> Difference {
    let brightness = luma(tissue).max(1.0);
    let t = tissue.map(|v| v / brightness);
    let r: [f32; 3] = std::array::from_fn(|c| (color[c] - tissue[c]) / brightness);
    let dot = |a: [f32; 3], b: [f32; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    let one = [1.0; 3];
    let (tt, tw, ww) = (dot(t, t) + (NOISE / LIT).powi(2), dot(t, one), 3.0);
    let (tr, wr) = (dot(t, r), dot(one, r));
    let determinant = tt * ww - tw * tw;
    Difference {
        lamp: (tt * wr - tw * tr) / determinant,
        lit: (ww * tr - tw * wr) / determinant,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TISSUE: [f32; 3] = [170.0, 80.0, 70.0];

    #[test]
    fn a_few_clean_answers_outvote_a_dazzled_crowd() {
        let mut tissue = Tissue::default();
        for i in 0..20 {
            tissue.hear(TISSUE.map(|c| c + 12.0 + 8.0 * i as f32));
        }
        for factor in [1.0, 1.01, 1.02] {
            tissue.hear(TISSUE.map(|c| c * factor));
        }
        assert_eq!(tissue.answers(), 23);
        assert!((luma(tissue.judge().color) / luma(TISSUE) - 1.01).abs() < 0.01);
    }

    #[test]
    fn a_crowd_under_white_light_is_not_tissue_unless_it_is_nearly_all() {
        let heard = |color: [f32; 3], crowd: usize, clipped: usize| {
            let mut tissue = Tissue::default();
            for _ in 0..crowd {
                tissue.hear(color);
            }
            for _ in 0..10 {
                tissue.hear(TISSUE);
            }
            for _ in 0..clipped {
                tissue.hear_clipped();
            }
            tissue.judge().color
        };
        let near = |a: [f32; 3], b: [f32; 3]| (0..3).all(|c| (a[c] - b[c]).abs() < 1.0);
        let lobe = TISSUE.map(|c| c + 60.0);
        assert!(near(heard(lobe, 20, 0), TISSUE));
        assert!(near(heard(lobe, 60, 0), lobe));
        // Those that show nothing but white were dazzled there too.
        assert!(near(heard(lobe, 60, 30), TISSUE));
        // Fat is another colour.
        let fat = [215.0, 190.0, 120.0];
        assert!(near(heard(fat, 20, 0), fat));
    }

    #[test]
    fn few_that_agree_under_the_lamp_are_not_believed() {
        // A lobe that stays on its bump: no two but the brightest show the same.
        let mut tissue = Tissue::default();
        for levels in [28.0, 52.0, 75.0, 88.0, 120.0, 138.0, 139.0, 160.0, 163.0, 165.0] {
            tissue.hear(TISSUE.map(|c| c + levels));
        }
        let verdict = tissue.judge();
        assert!(!verdict.is_sure);
        assert!((luma(verdict.color) - luma(TISSUE) - 28.0).abs() < 1e-3, "{verdict:?}");
        // Three that saw it clean.
        for _ in 0..3 {
            tissue.hear(TISSUE);
        }
        let verdict = tissue.judge();
        assert!(
            verdict.is_sure && (luma(verdict.color) - luma(TISSUE)).abs() < 1e-3,
            "{verdict:?}"
        );
    }

    #[test]
    fn a_tight_crowd_is_tissue_however_bright() {
        let mut tissue = Tissue::default();
        let white = [210.0, 190.0, 180.0];
        for i in 0..30 {
            tissue.hear(white.map(|c| c * (0.99 + 0.0005 * i as f32)));
        }
        for _ in 0..6 {
            tissue.hear(TISSUE);
        }
        assert!((luma(tissue.judge().color) / luma(white) - 1.0).abs() < 0.02);
    }

    #[test]
    fn white_light_is_the_lamps_and_better_light_is_not() {
        let share = |color: [f32; 3]| difference(color, TISSUE).lamp;
        for levels in [4.0, 10.0, 40.0] {
            let expected = levels / luma(TISSUE);
            let found = share(TISSUE.map(|c| c + levels));
            assert!((found / expected - 1.0).abs() < 0.25, "{found} of {expected}");
        }
        // The prior on how a place is lit shrinks that part: of a twentieth more light on this red the model itself calls 0.0247 the lamp's,
        // and of half the light 0.26 darkness (the equations of `difference` by hand).
        assert!(share(TISSUE.map(|c| c * 1.05)).abs() < 0.025);
        // Steel and the black surround are darker than any lamp explains.
        assert!(difference(TISSUE.map(|c| 0.5 * c), TISSUE).lit < -0.2 && difference([5.0; 3], TISSUE).lit < -0.4);
        assert!(difference(TISSUE, TISSUE.map(|c| c + 30.0)).lit > -0.12);
        // White tissue: brightness alone decides.
        assert!(difference([215.0; 3], [195.0; 3]).lamp > 0.02);
    }
}
