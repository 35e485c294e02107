//! Video in and out, against files that the `ffmpeg` command makes and reads.
#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::print_stdout,
    reason = "helpers of tests fail as tests do; the measurement by hand prints"
)]

use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::Arc;

use endofield::image::buffer::{Image, Rgb8};
use endofield::image::pool::Pool;
use endofield::media::error::MediaError;
use endofield::media::reader::{Input, VideoInfo, VideoReader};
use endofield::media::writer::{Output, Sound, VideoWriter, WriterSettings};
use endofield::pipeline::stage::{Sink, Source, SourceError};
use endofield::sinks::mask::MaskSink;
use endofield::sinks::side_by_side::SideBySideSink;
use endofield::sinks::video::VideoSink;
use endofield::sources::recording::{Playback, RecordingSource};
use endofield::time::{ManualClock, Timestamp};
use tempfile::TempDir;

const WIDTH: usize = 128;
const HEIGHT: usize = 96;
/// Numbers that the gray square can tell apart.
const CYCLE: usize = 37;
const QUADRANTS: [Rgb8; 4] = [[200, 60, 50], [60, 150, 70], [70, 80, 190], [210, 190, 150]];

/// Four colours, and in the middle a gray square whose level tells the frame's number.
fn scene(number: usize) -> Image<Rgb8> {
    let mut image = Image::filled(WIDTH, HEIGHT, [0; 3]);
    for y in 0..HEIGHT {
        for x in 0..WIDTH {
            image.set(
                x,
                y,
                QUADRANTS[usize::from(x >= WIDTH / 2) + 2 * usize::from(y >= HEIGHT / 2)],
            );
        }
    }
    let level = 30 + 6 * (number % CYCLE) as u8;
    for y in 32..64 {
        for x in 48..80 {
            image.set(x, y, [level; 3]);
        }
    }
    image
}

fn mean_around(image: &Image<Rgb8>, x: usize, y: usize) -> [f64; 3] {
    let mut sum = [0.0; 3];
    for v in y - 4..y + 4 {
        for u in x - 4..x + 4 {
            for (total, value) in sum.iter_mut().zip(image.at(u, v)) {
                *total += f64::from(value) / 64.0;
            }
        }
    }
    sum
}

fn number_shown(image: &Image<Rgb8>) -> usize {
    ((mean_around(image, 64, 48)[1] - 30.0) / 6.0).round() as usize
}

fn assert_colors(image: &Image<Rgb8>, tolerance: f64, what: &str) {
    for (index, expected) in QUADRANTS.iter().enumerate() {
        let found = mean_around(image, 24 + 80 * (index % 2), 16 + 64 * (index / 2));
        for (e, f) in expected.iter().zip(found) {
            assert!(
                (f64::from(*e) - f).abs() <= tolerance,
                "{what}: expected {expected:?}, found {found:?}"
            );
        }
    }
}

fn run(command: &mut Command) -> Vec<u8> {
    let output = command
        .stdin(Stdio::null())
        .output()
        .expect("the ffmpeg command is installed");
    assert!(
        output.status.success(),
        "{command:?}: {}",
        String::from_utf8_lossy(&output.stderr)
    );
    output.stdout
}

/// Frames 0..count of [`scene`] through `ffmpeg`, with what is given after the input.
fn make_video(path: &Path, count: usize, arguments: &[&str]) {
    let mut child = Command::new("ffmpeg")
        .args([
            "-v",
            "error",
            "-y",
            "-f",
            "rawvideo",
            "-pix_fmt",
            "rgb24",
            "-s",
            &format!("{WIDTH}x{HEIGHT}"),
            "-r",
            "25",
            "-i",
            "-",
        ])
        .args(arguments)
        .arg(path)
        .stdin(Stdio::piped())
        .spawn()
        .expect("the ffmpeg command is installed");
    let mut pipe = child.stdin.take().unwrap();
    for number in 0..count {
        pipe.write_all(scene(number).as_bytes()).unwrap();
    }
    drop(pipe);
    assert!(child.wait().unwrap().success(), "ffmpeg {arguments:?}");
}

const BT601: &str = "scale=out_color_matrix=bt601:out_range=tv:flags=accurate_rnd,format=yuv420p";

struct Read {
    info: VideoInfo,
    frames: Vec<(u64, Timestamp, Image<Rgb8>)>,
    error: Option<MediaError>,
}

fn read_on(mut reader: VideoReader) -> Read {
    let pool = Pool::new(4);
    let mut read = Read {
        info: reader.info().clone(),
        frames: Vec::new(),
        error: None,
    };
    loop {
        match reader.next_frame(&pool) {
            Ok(Some(frame)) => read.frames.push((frame.number, frame.timestamp, frame.image.clone())),
            Ok(None) => return read,
            Err(error) => {
                read.error = Some(error);
                assert!(
                    reader.next_frame(&pool).unwrap().is_none(),
                    "after an error the video is at its end"
                );
                return read;
            }
        }
    }
}

fn read(path: &Path) -> Read {
    read_on(VideoReader::open(&Input::from_argument(path)).unwrap())
}

fn assert_all_frames(read: &Read, count: usize, what: &str) {
    assert!(read.error.is_none(), "{what}: {:?}", read.error);
    assert_eq!(read.frames.len(), count, "{what}");
    for (index, (number, _, image)) in read.frames.iter().enumerate() {
        assert_eq!(*number, index as u64, "{what}");
        assert_eq!(number_shown(image), index % CYCLE, "{what}");
    }
}

fn open_error(path: &Path) -> String {
    VideoReader::open(&Input::File(path.into()))
        .map(|_| ())
        .unwrap_err()
        .to_string()
}

#[test]
fn every_codec_and_container_is_read() {
    let folder = TempDir::new().unwrap();
    let x264 = ["-vf", BT601, "-c:v", "libx264", "-crf", "8"];
    let cases: [(&str, &[&str], f64); 10] = [
        ("h264.mp4", &x264, 4.0),
        ("h264.mkv", &x264, 4.0),
        ("h264.mov", &x264, 4.0),
        ("h264.avi", &["-vf", BT601, "-c:v", "libx264", "-crf", "8", "-bf", "0"], 4.0),
        (
            "hevc.mp4",
            &["-vf", BT601, "-c:v", "libx265", "-crf", "8", "-x265-params", "log-level=none"],
            4.0,
        ),
        (
            "mpeg2.avi",
            &["-vf", BT601, "-c:v", "mpeg2video", "-q:v", "2", "-bf", "0"],
            5.0,
        ),
        ("mpeg2.mkv", &["-vf", BT601, "-c:v", "mpeg2video", "-q:v", "2"], 5.0),
        (
            "mjpeg.avi",
            &[
                "-vf",
                "scale=out_color_matrix=bt601:out_range=pc,format=yuvj420p",
                "-c:v",
                "mjpeg",
                "-q:v",
                "2",
            ],
            5.0,
        ),
        (
            "prores.mov",
            &[
                "-vf",
                "scale=out_color_matrix=bt601:out_range=tv,format=yuv422p10le",
                "-c:v",
                "prores_ks",
            ],
            4.0,
        ),
        (
            "vp9.mkv",
            &[
                "-vf",
                BT601,
                "-c:v",
                "libvpx-vp9",
                "-crf",
                "10",
                "-b:v",
                "0",
                "-cpu-used",
                "8",
                "-deadline",
                "realtime",
            ],
            5.0,
        ),
    ];
    for (name, arguments, tolerance) in cases {
        let path = folder.path().join(name);
        make_video(&path, 12, arguments);
        let read = read(&path);
        assert_all_frames(&read, 12, name);
        assert_eq!((read.info.width, read.info.height), (WIDTH, HEIGHT), "{name}");
        assert!(
            (read.info.frames_per_second() - 25.0).abs() < 0.01,
            "{name}: {:?}",
            read.info.average_frame_rate
        );
        assert!(!read.info.interlaced && !read.info.has_audio, "{name}");
        assert_colors(&read.frames[5].2, tolerance, name);
        for (index, pair) in read.frames.windows(2).enumerate() {
            let step = (pair[1].1 - pair[0].1).milliseconds();
            assert!((step - 40.0).abs() <= 1.0, "{name}: {step} ms after frame {index}");
        }
    }
}

#[test]
fn tags_decide_matrix_and_range() {
    let folder = TempDir::new().unwrap();
    for (matrix, tag) in [("bt601", "smpte170m"), ("bt709", "bt709"), ("bt2020", "bt2020nc")] {
        for range in ["tv", "pc"] {
            for format in ["yuv420p", "yuv422p", "yuv444p", "yuv420p10le", "yuv422p10le", "yuv444p10le"] {
                let path = folder.path().join(format!("{matrix}_{range}_{format}.mkv"));
                let filter = format!("scale=out_color_matrix={matrix}:out_range={range}:flags=accurate_rnd,format={format}");
                make_video(
                    &path,
                    2,
                    &["-vf", &filter, "-c:v", "ffv1", "-colorspace", tag, "-color_range", range],
                );
                let read = read(&path);
                assert_all_frames(&read, 2, &path.display().to_string());
                assert_eq!(read.info.bit_depth, if format.ends_with("10le") { 10 } else { 8 });
                assert_colors(&read.frames[1].2, 2.0, &path.display().to_string());
            }
        }
    }
}

#[test]
fn ten_bit_hevc_is_read() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("ten.mkv");
    let filter = "scale=out_color_matrix=bt601:out_range=tv,format=yuv420p10le";
    make_video(
        &path,
        6,
        &[
            "-vf",
            filter,
            "-c:v",
            "libx265",
            "-crf",
            "8",
            "-x265-params",
            "log-level=none",
        ],
    );
    let read = read(&path);
    assert_all_frames(&read, 6, "ten bit");
    assert_eq!(read.info.bit_depth, 10);
    assert_colors(&read.frames[3].2, 4.0, "ten bit");
}

#[test]
fn other_formats_go_through_the_scaler() {
    let folder = TempDir::new().unwrap();
    for (format, codec) in [
        ("yuv410p", "ffv1"),
        ("yuv411p", "ffv1"),
        ("gbrp", "ffv1"),
        ("bgr24", "rawvideo"),
        ("bgr0", "ffv1"),
    ] {
        let path = folder.path().join(format!("{format}.avi"));
        let filter = format!("scale=out_color_matrix=bt601:out_range=tv,format={format}");
        make_video(&path, 3, &["-vf", &filter, "-c:v", codec]);
        let read = read(&path);
        assert_all_frames(&read, 3, format);
        assert_colors(&read.frames[1].2, 3.0, format);
    }
}

#[test]
fn interlaced_video_is_deinterlaced_frame_by_frame() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("pal.mkv");
    make_video(
        &path,
        10,
        &[
            "-vf",
            BT601,
            "-c:v",
            "mpeg2video",
            "-q:v",
            "2",
            "-flags",
            "+ildct+ilme",
            "-top",
            "1",
        ],
    );
    let read = read(&path);
    assert!(read.info.interlaced);
    assert_all_frames(&read, 10, "interlaced");
    assert_colors(&read.frames[4].2, 6.0, "interlaced");
    for pair in read.frames.windows(2) {
        assert!(((pair[1].1 - pair[0].1).milliseconds() - 40.0).abs() <= 1.0);
    }
}

/// Time stamps in units of 1/12800 s with gaps of one, two and three frames.
fn variable_rate(path: &Path, count: usize) -> Vec<i64> {
    let filter = format!("{BT601},setpts='N+floor(N/3)+floor(N/5)'");
    make_video(
        path,
        count,
        &[
            "-vf",
            &filter,
            "-enc_time_base",
            "1:12800",
            "-vsync",
            "passthrough",
            "-c:v",
            "libx264",
            "-video_track_timescale",
            "12800",
            // Without: ffmpeg 7 writes an edit list that ends before the last frame, which then nobody is to show; and with
            // B-frames the edit list is what takes their delay off.
            "-use_editlist",
            "0",
            "-bf",
            "0",
        ],
    );
    (0..count as i64).map(|n| (n + n / 3 + n / 5) * 40_000_000).collect()
}

#[test]
fn variable_frame_rate_survives_reading_and_writing() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("vfr.mp4");
    let expected = variable_rate(&path, 14);
    let first = read(&path);
    assert_all_frames(&first, 14, "vfr");
    assert_eq!(first.frames.iter().map(|f| f.1.0).collect::<Vec<_>>(), expected);
    for ending in ["mp4", "mkv", "mov"] {
        let copy = folder.path().join(format!("copy.{ending}"));
        write_all(&copy, &first, &WriterSettings::like(&first.info));
        let second = read(&copy);
        assert_all_frames(&second, 14, ending);
        assert_eq!(second.frames.iter().map(|f| f.1.0).collect::<Vec<_>>(), expected, "{ending}");
    }
}

fn write_all(path: &Path, source: &Read, settings: &WriterSettings) {
    let mut writer = VideoWriter::create(&Output::from_argument(path).unwrap(), settings, false).unwrap();
    for (_, time, image) in &source.frames {
        writer.write(image, *time).unwrap();
    }
    writer.finish().unwrap();
}

fn probe(path: &Path, stream: &str, entries: &str) -> String {
    let output = run(Command::new("ffprobe")
        .args([
            "-v",
            "error",
            "-select_streams",
            stream,
            "-show_entries",
            entries,
            "-of",
            "default=nw=1:nk=1",
        ])
        .arg(path));
    String::from_utf8(output)
        .unwrap()
        .split_whitespace()
        .collect::<Vec<_>>()
        .join(" ")
}

#[test]
fn sound_tags_and_metadata_are_kept() {
    let folder = TempDir::new().unwrap();
    let (silent, path) = (folder.path().join("silent.mp4"), folder.path().join("in.mp4"));
    // Since ffmpeg 7 what the frames say wins over the options, so both say it.
    let filter = "scale=out_color_matrix=bt709:out_range=tv,format=yuv420p,\
                  setparams=colorspace=bt709:color_primaries=bt709:color_trc=bt709:range=tv";
    let tags = [
        "-colorspace",
        "bt709",
        "-color_primaries",
        "bt709",
        "-color_trc",
        "bt709",
        "-color_range",
        "tv",
    ];
    make_video(&silent, 40, &[&["-vf", filter, "-c:v", "libx264"][..], &tags[..]].concat());
    run(Command::new("ffmpeg")
        .args(["-v", "error", "-y", "-i"])
        .arg(&silent)
        .args([
            "-f",
            "lavfi",
            "-i",
            "sine=frequency=440:duration=1.6",
            "-c:v",
            "copy",
            "-c:a",
            "aac",
            "-metadata",
            "title=Case 7",
        ])
        .arg(&path));
    let first = read(&path);
    assert!(first.info.has_audio);
    let mut settings = WriterSettings::like(&first.info);
    settings.sound = Some(Sound {
        path: path.clone(),
        start: None,
        end: None,
    });
    for ending in ["mp4", "mkv", "mov", "avi"] {
        let copy = folder.path().join(format!("copy.{ending}"));
        write_all(&copy, &first, &settings);
        assert_eq!(probe(&copy, "a", "stream=codec_name"), "aac", "{ending}");
        let packets = probe(&copy, "a", "packet=pts_time");
        let count = packets.split(' ').count();
        assert!((68..=71).contains(&count), "{ending}: {count} sound packets");
        if ending != "avi" {
            let start: f64 = packets.split(' ').next().unwrap().parse().unwrap();
            assert!(start.abs() < 0.001, "{ending}: sound begins at {start}");
        }
        let second = read(&copy);
        assert_all_frames(&second, 40, ending);
        if ending != "avi" {
            assert_eq!(
                probe(&copy, "v", "stream=color_space,color_range,color_primaries,color_transfer"),
                "tv bt709 bt709 bt709",
                "{ending}"
            );
            assert_eq!(probe(&copy, "v", "format_tags=title"), "Case 7", "{ending}");
        }
        assert_eq!(second.info.color.matrix_name(), "bt709", "{ending}");
    }
}

#[test]
fn a_trimmed_clip_keeps_sound_and_pictures_together() {
    let folder = TempDir::new().unwrap();
    let (silent, path, copy) = (
        folder.path().join("s.mp4"),
        folder.path().join("in.mp4"),
        folder.path().join("out.mp4"),
    );
    make_video(&silent, 35, &["-vf", BT601, "-c:v", "libx264"]);
    run(Command::new("ffmpeg")
        .args(["-v", "error", "-y", "-i"])
        .arg(&silent)
        .args([
            "-f",
            "lavfi",
            "-i",
            "sine=frequency=440:duration=1.4",
            "-c:v",
            "copy",
            "-c:a",
            "aac",
        ])
        .arg(&path));
    let start = Timestamp::from_seconds(0.5);
    let end = Timestamp::from_seconds(1.0);
    let mut reader = VideoReader::open(&Input::File(path.clone())).unwrap();
    reader.seek(start).unwrap();
    let part = read_on(reader);
    assert_eq!(part.frames[0].0, 13);
    let mut settings = WriterSettings::like(&part.info);
    settings.origin = part.frames[0].1;
    settings.sound = Some(Sound {
        path,
        start: Some(start),
        end: Some(end),
    });
    let mut writer = VideoWriter::create(&Output::File(copy.clone()), &settings, false).unwrap();
    for (_, time, image) in part.frames.iter().take_while(|f| f.1 < end) {
        writer.write(image, *time).unwrap();
    }
    writer.finish().unwrap();
    let second = read(&copy);
    assert_eq!(second.frames.len(), 12);
    assert_eq!(second.frames[0].1, Timestamp(0));
    let packets = probe(&copy, "a", "packet=pts_time");
    let times: Vec<f64> = packets.split(' ').map(|t| t.parse().unwrap()).collect();
    assert!(times[0] < 0.03 && *times.last().unwrap() < 0.5, "{times:?}");
    assert!((20..=24).contains(&times.len()), "{times:?}");
}

#[test]
fn seeking_lands_on_the_frame_and_keeps_its_number() {
    let folder = TempDir::new().unwrap();
    for (name, arguments) in [
        ("b.mp4", &["-vf", BT601, "-c:v", "libx264", "-g", "10", "-bf", "3"][..]),
        (
            "b.mkv",
            &["-vf", BT601, "-c:v", "libx265", "-g", "10", "-x265-params", "log-level=none"],
        ),
        ("b.avi", &["-vf", BT601, "-c:v", "mjpeg"]),
    ] {
        let path = folder.path().join(name);
        make_video(&path, 36, arguments);
        for target in [0, 3, 11, 20, 29, 35] {
            let mut reader = VideoReader::open(&Input::File(path.clone())).unwrap();
            reader.seek(Timestamp::from_seconds(target as f64 * 0.04 - 0.01)).unwrap();
            let part = read_on(reader);
            assert_eq!(part.frames.len(), 36 - target, "{name} from {target}");
            for (index, (number, _, image)) in part.frames.iter().enumerate() {
                assert_eq!(*number as usize, target + index, "{name}");
                assert_eq!(number_shown(image), target + index, "{name}");
            }
        }
    }
}

#[test]
fn masks_come_back_bit_exact_everywhere() {
    let folder = TempDir::new().unwrap();
    let codes = [0, 64, 128, 192, 255];
    let masks: Vec<Image<u8>> = (0..7)
        .map(|n| {
            let pixels = (0..WIDTH * HEIGHT).map(|i| codes[(i / 5 + i * i / 77 + n * 3) % 5]).collect();
            Image::from_vec(WIDTH, HEIGHT, pixels).unwrap()
        })
        .collect();
    let settings = WriterSettings::new(WIDTH, HEIGHT, (25, 1)).for_masks();
    for ending in ["mp4", "mkv", "avi", "mov"] {
        let path = folder.path().join(format!("mask.{ending}"));
        write_masks(&path, &masks, &settings);
        let bytes = run(Command::new("ffmpeg")
            .args(["-v", "error", "-i"])
            .arg(&path)
            .args(["-f", "rawvideo", "-pix_fmt", "gray", "-"]));
        assert_eq!(bytes.len(), masks.len() * WIDTH * HEIGHT, "{ending}");
        let expected: Vec<u8> = masks.iter().flat_map(|m| m.pixels().to_vec()).collect();
        assert!(bytes == expected, "{ending}: not bit-exact");
        let ours = read(&path);
        for ((_, _, image), mask) in ours.frames.iter().zip(&masks) {
            assert!(
                image.pixels().iter().zip(mask.pixels()).all(|(rgb, m)| rgb == &[*m; 3]),
                "{ending}: read back"
            );
        }
    }
    let pattern = folder.path().join("masks/");
    write_masks(Path::new(&format!("{}/", pattern.display())), &masks, &settings);
    for (number, mask) in masks.iter().enumerate() {
        let picture = image::open(pattern.join(format!("{number:06}.png"))).unwrap();
        assert_eq!(picture.color(), image::ColorType::L8);
        assert_eq!(picture.to_luma8().as_raw(), mask.pixels());
    }
}

fn write_masks(path: &Path, masks: &[Image<u8>], settings: &WriterSettings) {
    let mut writer = VideoWriter::create(&Output::from_argument(path).unwrap(), settings, false).unwrap();
    for (number, mask) in masks.iter().enumerate() {
        writer
            .write_gray(mask, Timestamp::from_seconds(number as f64 * 0.04))
            .unwrap();
    }
    writer.finish().unwrap();
}

#[test]
fn pictures_go_out_and_come_back() {
    let folder = TempDir::new().unwrap();
    let pattern = folder.path().join("p_%03d.png");
    let settings = WriterSettings::new(WIDTH, HEIGHT, (25, 1));
    let mut writer = VideoWriter::create(&Output::from_argument(&pattern).unwrap(), &settings, false).unwrap();
    for number in 0..11 {
        writer.write(&scene(number), Timestamp(0)).unwrap();
    }
    writer.finish().unwrap();
    assert!(folder.path().join("p_010.png").exists());
    for input in [pattern.as_path(), folder.path()] {
        let read = read(input);
        assert_all_frames(&read, 11, "pictures");
        assert_eq!(read.frames[7].2, scene(7));
        assert_eq!(read.frames[5].1, Timestamp(200_000_000));
    }
    let again = VideoWriter::create(&Output::from_argument(&pattern).unwrap(), &settings, false).map(|_| ());
    assert!(again.unwrap_err().to_string().contains("--force"));
}

#[test]
fn y4m_is_read_and_written() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("in.y4m");
    make_video(&path, 6, &["-vf", BT601]);
    let reader = VideoReader::from_stream(std::fs::File::open(&path).unwrap(), "stdin").unwrap();
    let first = read_on(reader);
    assert_all_frames(&first, 6, "y4m");
    assert_colors(&first.frames[2].2, 3.0, "y4m");
    let copy = folder.path().join("out.y4m");
    let settings = WriterSettings::like(&first.info);
    let mut writer = VideoWriter::to_stream(std::fs::File::create(&copy).unwrap(), "stdout", &settings).unwrap();
    for (_, time, image) in &first.frames {
        writer.write(image, *time).unwrap();
    }
    writer.finish().unwrap();
    let second = read(&copy);
    assert_all_frames(&second, 6, "y4m copy");
    assert_colors(&second.frames[2].2, 3.0, "y4m copy");
    assert!(
        VideoReader::from_stream(&b"no video at all"[..], "stdin")
            .map(|_| ())
            .unwrap_err()
            .to_string()
            .contains("stdin")
    );
}

#[test]
fn what_is_written_plays_before_it_is_finished() {
    let folder = TempDir::new().unwrap();
    for ending in ["mp4", "mkv", "mov", "avi"] {
        let path = folder.path().join(format!("half.{ending}"));
        let settings = WriterSettings::new(WIDTH, HEIGHT, (10, 1));
        let mut writer = VideoWriter::create(&Output::File(path.clone()), &settings, false).unwrap();
        for number in 0..36 {
            writer.write(&scene(number), Timestamp(number as i64 * 100_000_000)).unwrap();
        }
        let half = folder.path().join(format!("killed.{ending}"));
        std::fs::copy(&path, &half).unwrap();
        let bytes = run(Command::new("ffmpeg")
            .args(["-v", "error", "-i"])
            .arg(&half)
            .args(["-f", "rawvideo", "-pix_fmt", "gray", "-"]));
        let frames = bytes.len() / (WIDTH * HEIGHT);
        // What the encoder and the current fragment still hold may be lost.
        assert!((10..=36).contains(&frames), "{ending}: {frames} frames");
        writer.finish().unwrap();
        assert_all_frames(&read(&path), 36, ending);
    }
}

#[test]
fn a_full_disk_is_told_and_what_was_written_plays() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("full.mp4");
    // `ulimit -f` bounds the size of the files a process may write, in blocks of 512 or 1024 bytes.
    let executable = std::env::current_exe().unwrap();
    let output = Command::new("sh")
        .args([
            "-c",
            "trap '' XFSZ; ulimit -f 300; exec \"$0\" --exact media::helper_that_writes_until_it_fails --ignored --nocapture",
        ])
        .arg(executable)
        .env("ENDOFIELD_TEST_OUTPUT", &path)
        .output()
        .unwrap();
    let told = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(
        told.contains("stays playable"),
        "{told} {}",
        String::from_utf8_lossy(&output.stderr)
    );
    let bytes = run(Command::new("ffmpeg")
        .args(["-v", "quiet", "-i"])
        .arg(&path)
        .args(["-f", "rawvideo", "-pix_fmt", "gray", "-"]));
    assert!(bytes.len() / (WIDTH * HEIGHT) >= 5, "{} bytes of pictures", bytes.len());
}

#[test]
#[ignore = "run by a_full_disk_is_told_and_what_was_written_plays under a file size limit"]
fn helper_that_writes_until_it_fails() {
    let Some(path) = std::env::var_os("ENDOFIELD_TEST_OUTPUT").map(PathBuf::from) else {
        return;
    };
    let settings = WriterSettings::new(WIDTH, HEIGHT, (5, 1));
    let mut writer = VideoWriter::create(&Output::File(path), &settings, false).unwrap();
    let mut state = 1_u32;
    for number in 0..2000 {
        let mut image = scene(number);
        for value in image.as_bytes_mut() {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            *value = value.wrapping_add((state >> 28) as u8);
        }
        if let Err(error) = writer.write(&image, Timestamp(number as i64 * 200_000_000)) {
            println!("{error}");
            writer.finish().unwrap();
            return;
        }
    }
    panic!("the limit was never reached");
}

#[test]
fn nothing_is_overwritten_without_force() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("kept.mp4");
    std::fs::write(&path, b"precious").unwrap();
    let settings = WriterSettings::new(WIDTH, HEIGHT, (25, 1));
    let refused = VideoWriter::create(&Output::File(path.clone()), &settings, false)
        .map(|_| ())
        .unwrap_err();
    assert!(matches!(refused, MediaError::Exists { .. }));
    assert_eq!(std::fs::read(&path).unwrap(), b"precious");
    VideoWriter::create(&Output::File(path), &settings, true)
        .unwrap()
        .finish()
        .unwrap();
    let unknown = Output::from_argument(Path::new("out.webm")).unwrap_err().to_string();
    assert!(unknown.contains(".webm") && unknown.contains(".mp4"), "{unknown}");
}

#[test]
fn bad_files_are_named_and_explained() {
    let folder = TempDir::new().unwrap();
    let at = |name: &str| folder.path().join(name);
    assert!(open_error(&at("none.mp4")).contains("no such file"));
    std::fs::write(at("zero.mp4"), b"").unwrap();
    assert!(open_error(&at("zero.mp4")).contains("0 bytes"));
    std::fs::write(at("text.mp4"), "This is a letter, not a video.\n".repeat(40)).unwrap();
    let text = open_error(&at("text.mp4"));
    assert!(text.contains("text.mp4") && text.contains("expected a video"), "{text}");
    run(Command::new("ffmpeg")
        .args(["-v", "error", "-f", "lavfi", "-i", "sine=duration=0.2", "-c:a", "aac"])
        .arg(at("sound.mp4")));
    assert!(
        open_error(&at("sound.mp4")).contains("found only audio"),
        "{}",
        open_error(&at("sound.mp4"))
    );
    make_video(&at("whole.mp4"), 36, &["-vf", BT601, "-c:v", "libx264", "-g", "5"]);
    let bytes = std::fs::read(at("whole.mp4")).unwrap();
    std::fs::write(at("no_index.mp4"), &bytes[..bytes.len() / 2]).unwrap();
    let cut = open_error(&at("no_index.mp4"));
    assert!(cut.contains("moov"), "{cut}");
}

#[test]
fn a_cut_off_file_yields_its_frames_and_then_an_error() {
    let folder = TempDir::new().unwrap();
    let h264 = ["-vf", BT601, "-c:v", "libx264", "-g", "5", "-movflags", "+faststart"];
    for (name, arguments) in [
        ("w.mp4", &h264[..]),
        ("w.mkv", &h264[..6]),
        ("w.avi", &["-vf", BT601, "-c:v", "mjpeg", "-q:v", "2"]),
    ] {
        let path = folder.path().join(name);
        make_video(&path, 36, arguments);
        let bytes = std::fs::read(&path).unwrap();
        std::fs::write(&path, &bytes[..bytes.len() * 6 / 10]).unwrap();
        let read = read(&path);
        let error = read
            .error
            .as_ref()
            .unwrap_or_else(|| panic!("{name}: no error after {} frames", read.frames.len()));
        assert!(
            matches!(error, MediaError::Truncated { frames, .. } if *frames == read.frames.len() as u64),
            "{name}: {error}"
        );
        assert!((3..36).contains(&read.frames.len()), "{name}: {} frames", read.frames.len());
    }
}

#[test]
fn a_change_of_size_is_an_error_that_names_both() {
    let folder = TempDir::new().unwrap();
    let at = |name: &str| folder.path().join(name);
    make_video(&at("a.ts"), 8, &["-vf", BT601, "-c:v", "libx264"]);
    make_video(
        &at("b.ts"),
        8,
        &[
            "-vf",
            "scale=64:48,format=yuv420p",
            "-c:v",
            "libx264",
            "-output_ts_offset",
            "0.32",
        ],
    );
    let both = [std::fs::read(at("a.ts")).unwrap(), std::fs::read(at("b.ts")).unwrap()].concat();
    std::fs::write(at("both.ts"), both).unwrap();
    let read = read(&at("both.ts"));
    assert_eq!(read.frames.len(), 8);
    let error = read.error.unwrap().to_string();
    assert!(
        error.contains("128×96") && error.contains("64×48") && error.contains("frame 8"),
        "{error}"
    );
}

/// Decoded again, an endoscope-like noisy picture must be what was written, up to 4:2:0 and a little rounding.
#[test]
fn writing_is_visually_lossless() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("noisy.mp4");
    let (width, height) = (480, 272);
    let mut state = 7_u32;
    let mut noise = || {
        let mut sum = 0;
        for _ in 0..4 {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            sum += (state >> 28) as i32;
        }
        f64::from(sum - 30) * 0.25
    };
    let mut frames = Vec::new();
    for number in 0..10 {
        let mut image = Image::filled(width, height, [0; 3]);
        for y in 0..height {
            for x in 0..width {
                let (u, v) = (x as f64 + 2.0 * f64::from(number), y as f64);
                let texture = 18.0 * (u / 7.0).sin() * (v / 9.0).cos() + 30.0 * (u / 41.0 + v / 53.0).sin();
                let luma_noise = noise();
                image.set(
                    x,
                    y,
                    [170.0, 90.0, 80.0].map(|base: f64| (base + texture + luma_noise).clamp(0.0, 255.0) as u8),
                );
            }
        }
        frames.push(image);
    }
    let settings = WriterSettings::new(width, height, (25, 1));
    let mut writer = VideoWriter::create(&Output::File(path.clone()), &settings, false).unwrap();
    for (number, image) in frames.iter().enumerate() {
        writer.write(image, Timestamp(number as i64 * 40_000_000)).unwrap();
    }
    writer.finish().unwrap();
    let read = read(&path);
    let mut squares = 0.0;
    for ((_, _, image), original) in read.frames.iter().zip(&frames) {
        squares += image
            .as_bytes()
            .iter()
            .zip(original.as_bytes())
            .map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2))
            .sum::<f64>();
    }
    let psnr = 10.0 * (255.0_f64.powi(2) * (10 * 3 * width * height) as f64 / squares).log10();
    assert_eq!(read.frames.len(), 10);
    assert!(psnr >= 46.0, "{psnr:.2} dB");
}

#[test]
fn what_is_written_has_the_colors_its_tags_promise() {
    let folder = TempDir::new().unwrap();
    for (matrix, tag) in [("bt601", "smpte170m"), ("bt709", "bt709"), ("bt2020", "bt2020nc")] {
        for range in ["tv", "pc"] {
            let name = format!("{matrix}_{range}");
            let (path, copy) = (
                folder.path().join(format!("{name}.mkv")),
                folder.path().join(format!("{name}.mp4")),
            );
            let filter = format!("scale=out_color_matrix={matrix}:out_range={range}:flags=accurate_rnd,format=yuv420p");
            make_video(
                &path,
                3,
                &["-vf", &filter, "-c:v", "ffv1", "-colorspace", tag, "-color_range", range],
            );
            let first = read(&path);
            write_all(&copy, &first, &WriterSettings::like(&first.info));
            assert_eq!(probe(&copy, "v", "stream=color_space,color_range"), format!("{range} {tag}"));
            // The same decoder on both sides: what differs is our doing.
            let means = [&path, &copy].map(|file| {
                let bytes = run(Command::new("ffmpeg")
                    .args(["-v", "error", "-i"])
                    .arg(file)
                    .args(["-f", "rawvideo", "-pix_fmt", "rgb24", "-"]));
                let pixels = bytes.as_chunks::<3>().0[..WIDTH * HEIGHT].to_vec();
                let image = Image::from_vec(WIDTH, HEIGHT, pixels).unwrap();
                [(24, 16), (104, 16), (24, 80), (104, 80)].map(|(x, y)| mean_around(&image, x, y))
            });
            for (before, after) in means[0].iter().flatten().zip(means[1].iter().flatten()) {
                assert!((before - after).abs() <= 2.0, "{name}: {means:?}");
            }
        }
    }
}

/// A small recording with sound, 30 frames at 25 per second.
fn small_recording(folder: &Path) -> PathBuf {
    let path = folder.join("recording.mp4");
    make_video(&path, 30, &["-vf", BT601, "-c:v", "libx264", "-crf", "8", "-g", "10"]);
    path
}

fn source(path: &Path, playback: Playback) -> Result<RecordingSource, SourceError> {
    let reader = VideoReader::open(&Input::File(path.into())).unwrap();
    RecordingSource::new(reader, playback, Arc::new(ManualClock::default()), Pool::new(8))
}

#[test]
fn a_recording_goes_through_source_and_sinks() {
    let folder = TempDir::new().unwrap();
    let path = small_recording(folder.path());
    let playback = Playback {
        exposure_times: Some((0..30).map(|n| Timestamp(5_000_000_000 + n * 39_000_000)).collect()),
        start: Some(Timestamp::from_seconds(0.2)),
        end: Some(Timestamp::from_seconds(0.6)),
        ..Playback::default()
    };
    let mut source = source(&path, playback).unwrap();
    let at = |name: &str| folder.path().join(name);
    let mut settings = WriterSettings::like(source.info());
    settings.origin = Timestamp::from_seconds(0.2);
    let create = |name: &str, settings: &WriterSettings| VideoWriter::create(&Output::File(at(name)), settings, false).unwrap();
    let wide = WriterSettings {
        width: SideBySideSink::output_width(WIDTH),
        ..settings.clone()
    };
    let mut sinks: [Box<dyn Sink>; 3] = [
        Box::new(VideoSink::new(create("enhanced.mp4", &settings))),
        Box::new(MaskSink::new(create("mask.mkv", &settings.for_masks()))),
        Box::new(SideBySideSink::new(create("side.mp4", &wide))),
    ];
    let mut ids = Vec::new();
    while let Some(mut frame) = source.next_frame().unwrap() {
        // In the line the runner keeps it.
        frame.original = Some(Pool::new(1).take_copy(&frame.image));
        let number = frame.id.0 as i64;
        assert_eq!(frame.exposed_at, Timestamp(5_000_000_000 + number * 39_000_000));
        assert_eq!(frame.presented_at, Timestamp(number * 40_000_000));
        assert_eq!(frame.since_previous.0, if ids.is_empty() { 0 } else { 39_000_000 });
        ids.push(frame.id.0);
        let frame = Arc::new(frame);
        for sink in &mut sinks {
            sink.consume(&frame).unwrap();
        }
    }
    assert_eq!(ids, (5..15).collect::<Vec<_>>());
    for sink in &mut sinks {
        sink.finish().unwrap();
    }
    let enhanced = read(&at("enhanced.mp4"));
    assert_eq!(enhanced.frames.len(), 10);
    assert_eq!(enhanced.frames[0].1, Timestamp(0));
    assert_eq!(number_shown(&enhanced.frames[9].2), 14);
    let mask = read(&at("mask.mkv"));
    assert_eq!(mask.frames.len(), 10);
    assert!(mask.frames.iter().all(|f| f.2.pixels().iter().all(|p| p == &[0; 3])));
    let side = read(&at("side.mp4"));
    assert_eq!((side.info.width, side.frames.len()), (2 * WIDTH + 4, 10));
}

#[test]
fn exposure_times_must_fit_the_video() {
    let folder = TempDir::new().unwrap();
    let path = small_recording(folder.path());
    let times = |count: i64| Playback {
        exposure_times: Some((0..count).map(|n| Timestamp(n * 40_000_000)).collect()),
        ..Playback::default()
    };
    let mut short = source(&path, times(12)).unwrap();
    for _ in 0..12 {
        assert!(short.next_frame().unwrap().is_some());
    }
    let told = short.next_frame().unwrap_err().to_string();
    assert!(told.contains("12 lines") && told.contains("frame 12"), "{told}");
    assert!(short.next_frame().unwrap().is_none());
    let backwards = Playback {
        exposure_times: Some(vec![Timestamp(0), Timestamp(40), Timestamp(30)]),
        ..Playback::default()
    };
    let told = source(&path, backwards).unwrap_err().to_string();
    assert!(told.contains("frame 2"), "{told}");
}

/// Processor seconds of this process so far, from the kernel's ticks of 10 ms.
fn processor_seconds() -> f64 {
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap();
    let fields: Vec<_> = stat.rsplit(')').next().unwrap().split_whitespace().collect();
    (fields[11].parse::<f64>().unwrap() + fields[12].parse::<f64>().unwrap()) / 100.0
}

#[test]
#[ignore = "a measurement by hand: ENDOFIELD_MEASURE=FILE [ENDOFIELD_COPY=FILE ENDOFIELD_CRF=N ENDOFIELD_PRESET=P]"]
fn measure_speed_and_fidelity() {
    let Some(path) = std::env::var_os("ENDOFIELD_MEASURE").map(PathBuf::from) else {
        return;
    };
    let pool = Pool::new(4);
    let mut reader = VideoReader::open(&Input::File(path.clone())).unwrap();
    let (before, mut alone) = (processor_seconds(), 0);
    while reader.next_frame(&pool).unwrap().is_some() {
        alone += 1;
    }
    println!(
        "decode alone {:.1} ms CPU per frame",
        1e3 * (processor_seconds() - before) / f64::from(alone)
    );
    let mut reader = VideoReader::open(&Input::File(path.clone())).unwrap();
    let mut settings = WriterSettings::like(reader.info());
    settings.sound = Some(Sound {
        path,
        start: None,
        end: None,
    });
    if let Ok(crf) = std::env::var("ENDOFIELD_CRF") {
        settings.crf = crf.parse().unwrap();
    }
    if let Ok(preset) = std::env::var("ENDOFIELD_PRESET") {
        settings.preset = preset;
    }
    let folder = TempDir::new().unwrap();
    let copy = std::env::var_os("ENDOFIELD_COPY").map_or_else(|| folder.path().join("copy.mp4"), PathBuf::from);
    let mut writer = VideoWriter::create(&Output::File(copy.clone()), &settings, false).unwrap();
    let (mut decode, mut encode, mut frames) = (0.0, 0.0, 0);
    let mut kept = Vec::new();
    loop {
        let before = processor_seconds();
        let Some(frame) = reader.next_frame(&pool).unwrap() else {
            break;
        };
        let between = processor_seconds();
        writer.write(&frame.image, frame.timestamp).unwrap();
        decode += between - before;
        encode += processor_seconds() - between;
        frames += 1;
        if frames <= 60 {
            kept.push(frame.image);
        }
    }
    writer.finish().unwrap();
    let mut again = VideoReader::open(&Input::File(copy.clone())).unwrap();
    let (mut squares, mut count) = (0.0, 0);
    for image in &kept {
        let frame = again.next_frame(&pool).unwrap().unwrap();
        for (a, b) in frame.image.as_bytes().iter().zip(image.as_bytes()) {
            squares += (f64::from(*a) - f64::from(*b)).powi(2);
            count += 1;
        }
    }
    println!(
        "{frames} frames, {:?} crf {} {}: decode {:.1} ms, encode {:.1} ms CPU per frame (threads overlap), {:.2} dB, {} kB",
        (settings.width, settings.height),
        settings.crf,
        settings.preset,
        1e3 * decode / f64::from(frames),
        1e3 * encode / f64::from(frames),
        10.0 * (255.0_f64.powi(2) * f64::from(count) / squares).log10(),
        std::fs::metadata(&copy).unwrap().len() / 1000
    );
}
