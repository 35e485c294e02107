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
}

impl Tissue {
    /// Forget the last place.
    pub fn clear(&mut self) {
        self.answers.clear();
    }

    /// One view's colour.
    pub fn hear(&mut self, color: [f32; 3]) {
        self.answers.push((darkness(color), color));
    }

    /// How many were heard.
    pub fn answers(&self) -> usize {
        self.answers.len()
    }

    /// The mean of the darkest answers that agree with each other; a dark middle one when no few agree. A tight crowd outvotes a darker
    /// few: the lamp dazzles every view differently, so what many show alike is tissue, however bright, and the few look past it.
    pub fn color(&mut self) -> [f32; 3] {
        let all = self.answers.len();
        self.answers.sort_unstable_by(|a, b| a.0.total_cmp(&b.0));
        let answers = &self.answers[..];
        let agreeing = |enough: usize, spread: f32| {
            (answers.windows(enough.max(1))).position(|group| group[group.len() - 1].0 <= (1.0 + spread) * group[0].0)
        };
        let few = FEWEST_AGREEING.max((AGREEING_SHARE * all as f32) as usize).min(all);
        let crowd = (CROWD_SHARE * all as f32) as usize;
        let crowded = if crowd > few { agreeing(crowd, CROWD_SPREAD) } else { None };
        let Some(first) = crowded.or_else(|| agreeing(few, AGREEMENT)) else {
            return answers[all / 8].1;
        };
        let group = answers[first..]
            .iter()
            .take_while(|a| a.0 <= (1.0 + AGREEMENT) * answers[first].0);
        let (sum, count) = group.fold(([0.0_f32; 3], 0.0_f32), |(sum, count), (_, color)| {
            (std::array::from_fn(|c| sum[c] + color[c]), count + 1.0)
        });
        sum.map(|s| s / count)
    }
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
        assert!((luma(tissue.color()) / luma(TISSUE) - 1.01).abs() < 0.01);
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
        assert!((luma(tissue.color()) / luma(white) - 1.0).abs() < 0.02);
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
