//! The light field of the video's own last frames.

use std::path::Path;

use crate::support::command::{endofield, told};

/// Share of the frames' pixels with this code, mean over the masks of frames from `first` on.
fn share(masks: &Path, code: u8, first: u32) -> f64 {
    let (mut found, mut all) = (0_usize, 0_usize);
    for number in first.. {
        let Ok(mask) = image::open(masks.join(format!("{number:06}.png"))) else {
            break;
        };
        let mask = mask.into_luma8();
        found += mask.pixels().filter(|pixel| pixel.0[0] == code).count();
        all += mask.pixels().len();
    }
    assert!(all > 0, "no masks from frame {first} on in {}", masks.display());
    found as f64 / all as f64
}

#[test]
fn without_a_survey_specularities_are_filled_from_recent_frames_and_marked_so() {
    let folder = tempfile::tempdir().unwrap();
    let simulate = ["simulate", "sim", "--size", "320x180", "--frames", "4", "--seed", "3", "-q"];
    let output = endofield(&simulate, folder.path());
    assert!(output.status.success(), "{}", told(&output));
    let process = |out: &str, mask: &str, more: &[&str]| {
        let mut arguments = vec!["process", "sim/survey", "-o", out, "--mask-out", mask, "-q"];
        arguments.extend([
            "--stages",
            "undistort,specular",
            "--end",
            "1.6",
            "--set",
            "rolling.views_between=24",
        ]);
        arguments.extend(more);
        let output = endofield(&arguments, folder.path());
        assert!(output.status.success(), "{}", told(&output));
    };
    process("out.mp4", "mask/", &[]);
    process("again.mp4", "again/", &[]);
    process("off.mp4", "off/", &["--set", "rolling.enabled=false"]);
    let masks = |name: &str| folder.path().join(name);
    // Nothing before there are views, and nothing from a survey, as there is none.
    assert_eq!(share(&masks("off/"), 128, 0), 0.0);
    assert_eq!(share(&masks("mask/"), 255, 0), 0.0);
    let (recent, left) = (share(&masks("mask/"), 128, 25), share(&masks("off/"), 64, 25));
    assert!(recent > 0.3 * left, "{recent} of the pixels filled, {left} marked without");
    for number in [0, 25, 35] {
        let read = |name: &str| std::fs::read(masks(name).join(format!("{number:06}.png"))).unwrap();
        assert_eq!(read("mask/"), read("again/"), "frame {number} differs from run to run");
    }
}
