//! Whether picture and arm agree in time, watched while both run: pictures of a plane under a camera that wanders, and an arm whose
//! stamps jump, or do not.

use std::f64::consts::TAU;
use std::io::Write;
use std::sync::{Arc, Mutex};

use endofield::calibration::time_offset::drift::Verdict;
use endofield::frame::{Frame, FrameId};
use endofield::geometry::transform::Transform;
use endofield::image::pool::{Pool, Pooled};
use endofield::pipeline::stage::Sink as _;
use endofield::robot::feed::reader::SharedPoses;
use endofield::robot::pose_buffer::{PoseBuffer, Settings};
use endofield::robot::trajectory::TimedPose;
use endofield::sinks::drift::DriftSink;
use endofield::time::{Span, Timestamp};
use nalgebra::{UnitQuaternion, Vector3};
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;

const SIZE: (usize, usize) = (240, 136);
const LENGTH_S: f64 = 40.0;
const JUMP_AT_S: f64 = 14.0;
/// Pictures a second.
const RATE_HZ: f64 = 12.5;
/// Of the picture's width, the focal length.
const FOCAL_WIDTHS: f64 = 0.9;
/// How far the plane is, mm.
const DISTANCE_MM: f64 = 100.0;
/// The arm's own noise, mm and rad.
const NOISE: [f64; 2] = [0.2, 0.001];

/// Where the hand is, mm, and its turn, rad.
fn hand(t: f64) -> [[f64; 3]; 2] {
    let wave = |hz: f64, phase: f64| (TAU * hz * t + phase).sin() + 0.6 * (TAU * 1.7 * hz * t + 2.0 * phase).sin();
    [
        [9.0 * wave(0.21, 0.3), 8.0 * wave(0.17, 2.2), 6.0 * wave(0.13, 4.0)],
        [0.05 * wave(0.15, 1.0), 0.05 * wave(0.19, 5.0), 0.08 * wave(0.11, 3.0)],
    ]
}

/// The plane as the camera in the hand sees it then, small turns.
fn picture(t: f64, pool: &Pool<[u8; 3]>) -> Pooled<[u8; 3]> {
    let (width, height) = SIZE;
    let [[x, y, z], [tilt, pan, roll]] = hand(t);
    let (sin, cos) = roll.sin_cos();
    let focal = FOCAL_WIDTHS * width as f64;
    let growth = (DISTANCE_MM - z) / DISTANCE_MM;
    let mut image = pool.take(width, height);
    for row in 0..height {
        for (column, pixel) in image.row_mut(row).iter_mut().enumerate() {
            let (u, v) = (column as f64 - width as f64 / 2.0, row as f64 - height as f64 / 2.0);
            let a = growth * (cos * u - sin * v) + focal * (x / DISTANCE_MM + pan);
            let b = growth * (sin * u + cos * v) + focal * (y / DISTANCE_MM - tilt);
            let texture =
                (0.31 * a).sin() * (0.27 * b + 0.4).sin() + (0.13 * a - 0.17 * b).sin() + 0.6 * (0.41 * b + 0.11 * a).sin();
            *pixel = [120.0 + 30.0 * texture, 90.0 + 20.0 * texture, 80.0 + 20.0 * texture].map(|level| level as u8);
        }
    }
    image
}

#[derive(Clone, Default)]
struct Told(Arc<Mutex<Vec<u8>>>);

impl Write for Told {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.0.lock().unwrap().extend_from_slice(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

/// Play it; the warnings, and the last verdict. `late_ms` is what is added to a stamp's truth at a time.
fn watched(late_ms: impl Fn(f64) -> f64) -> (Vec<String>, Option<Verdict>) {
    let told = Told::default();
    let writer = told.clone();
    let subscriber = tracing_subscriber::fmt()
        .with_ansi(false)
        .with_writer(move || writer.clone())
        .finish();
    let poses = SharedPoses::new(PoseBuffer::new(&Settings::default()).unwrap());
    let mut random = ChaCha8Rng::seed_from_u64(7);
    let mut noisy =
        |truth: [f64; 3], size: f64| Vector3::from(truth.map(|value| value + size * random.sample::<f64, _>(StandardNormal)));
    let mut sink = DriftSink::new(poses.clone(), Span(0));
    let reading = sink.reading();
    let pool = Pool::new(2);
    let mut sent = 0;
    tracing::subscriber::with_default(subscriber, || {
        for number in 0..(LENGTH_S * RATE_HZ) as u64 {
            let t = 1.0 + number as f64 / RATE_HZ;
            // What the arm has told until now, 100 readings a second.
            while f64::from(sent) * 0.01 <= t + 0.05 {
                let at = f64::from(sent) * 0.01;
                let [place, turn] = hand(at);
                let (place, turn) = (noisy(place, NOISE[0]), noisy(turn, NOISE[1]));
                poses.lock().push(TimedPose {
                    stamp: Timestamp::from_seconds(at + late_ms(at) / 1e3),
                    base_from_hand: Transform::new(UnitQuaternion::from_scaled_axis(turn), place),
                });
                sent += 1;
            }
            let at = Timestamp::from_seconds(t);
            let frame = Frame::new(FrameId(number), at, at, picture(t, &pool));
            sink.consume(&Arc::new(frame)).unwrap();
        }
    });
    let text = String::from_utf8(told.0.lock().unwrap().clone()).unwrap();
    let warnings = text.lines().filter(|line| line.contains("WARN")).map(str::to_owned).collect();
    (warnings, reading.get())
}

#[test]
fn an_arm_whose_clock_is_steady_is_left_in_peace() {
    let (warnings, last) = watched(|_| 0.0);
    assert_eq!((warnings, last), (Vec::new(), Some(Verdict::Agree)));
}

#[test]
fn a_jump_of_the_arms_clock_is_told_once_and_by_how_much() {
    let (warnings, last) = watched(|t| if t < JUMP_AT_S { 0.0 } else { 80.0 });
    assert_eq!(warnings.len(), 1, "{warnings:#?}");
    assert!(
        warnings[0].contains("calibrate time-offset"),
        "it says what to do: {warnings:?}"
    );
    let Some(Verdict::Drifted { offset, sigma_ms }) = last else {
        panic!("the jump went unnoticed: {last:?}");
    };
    // Stamps that are late by 80 ms want 80 ms taken off. What is watched for is a drift that does harm, from 20 ms on: so well must
    // the new offset be told, from the 15 s behind the jump.
    assert!((offset.milliseconds() + 80.0).abs() < 20.0, "{offset:?} ± {sigma_ms}");
}
