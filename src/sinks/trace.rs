//! Where each frame was when: as a table (`timings.csv`), and as a trace that Perfetto and Chrome's `about:tracing` draw.
//!
//! The trace is an array of complete events of the Trace Event Format; a file that was cut off is read as well.

use std::fs::File;
use std::io::{BufWriter, Write as _};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::frame::Frame;
use crate::pipeline::stage::{Sink, SinkError};
use crate::robot::trajectory::stamp_text;
use crate::time::Timestamp;

/// What is written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TraceFormat {
    /// A line a frame.
    Table,
    /// An event a frame and stage.
    Events,
}

/// Writes each frame's times as it comes out of the line.
#[derive(Debug)]
pub struct TraceSink {
    path: PathBuf,
    file: BufWriter<File>,
    format: TraceFormat,
    /// Columns of the table, or rows of the drawing.
    stages: Vec<&'static str>,
    is_first: bool,
}

impl TraceSink {
    /// Begin the file; `stages` in the order of the line.
    pub fn new(path: &Path, format: TraceFormat, stages: Vec<&'static str>) -> Result<Self, SinkError> {
        let file = File::create(path).map_err(|error| SinkError(format!("cannot write {}: {error}", path.display())))?;
        let mut sink = Self {
            path: path.to_owned(),
            file: BufWriter::new(file),
            format,
            stages,
            is_first: true,
        };
        let head = match format {
            TraceFormat::Table => {
                let columns: String = sink.stages.iter().map(|stage| format!(",{stage}_ms")).collect();
                format!("frame,exposed_s,arrived_s,untouched,line_ms{columns}\n")
            }
            TraceFormat::Events => {
                let name = |(number, stage): (usize, &&str)| {
                    format!(
                        "{{\"ph\":\"M\",\"pid\":1,\"tid\":{},\"name\":\"thread_name\",\"args\":{{\"name\":\"{stage}\"}}}},\n",
                        number + 1
                    )
                };
                format!("[\n{}", sink.stages.iter().enumerate().map(name).collect::<String>())
            }
        };
        sink.write(&head)?;
        Ok(sink)
    }

    fn write(&mut self, text: &str) -> Result<(), SinkError> {
        self.file
            .write_all(text.as_bytes())
            .and_then(|()| {
                if self.format == TraceFormat::Table {
                    self.file.flush()
                } else {
                    Ok(())
                }
            })
            .map_err(|error| SinkError(format!("cannot write {}: {error}", self.path.display())))
    }

    fn row(&self, frame: &Frame) -> String {
        let left = frame.timings.last().map_or(frame.arrived_at, |timing| timing.left);
        let mut line = format!(
            "{},{},{},{},{:.3}",
            frame.id.0,
            stamp_text(frame.exposed_at),
            stamp_text(frame.arrived_at),
            u8::from(frame.untouched),
            (left - frame.arrived_at).milliseconds()
        );
        for stage in &self.stages {
            let timing = frame.timings.iter().find(|timing| timing.stage == *stage && !timing.bypassed);
            // An empty cell: it passed the stage by.
            line += &timing.map_or(",".to_owned(), |timing| {
                format!(",{:.3}", (timing.left - timing.entered).milliseconds())
            });
        }
        line + "\n"
    }

    fn events(&mut self, frame: &Frame) -> String {
        let microseconds = |at: Timestamp| at.0 as f64 * 1e-3;
        let mut text = String::new();
        for timing in &frame.timings {
            let row = self
                .stages
                .iter()
                .position(|stage| *stage == timing.stage)
                .map_or(0, |place| place + 1);
            let comma = if std::mem::take(&mut self.is_first) { "" } else { ",\n" };
            text += &format!(
                "{comma}{{\"ph\":\"X\",\"pid\":1,\"tid\":{row},\"name\":\"{}{}\",\"ts\":{:.3},\"dur\":{:.3},\"args\":{{\"frame\":{}}}}}",
                frame.id.0,
                if timing.bypassed { " passed by" } else { "" },
                microseconds(timing.entered),
                microseconds(timing.left) - microseconds(timing.entered),
                frame.id.0
            );
        }
        text
    }
}

impl Sink for TraceSink {
    fn name(&self) -> &'static str {
        match self.format {
            TraceFormat::Table => "timings",
            TraceFormat::Events => "trace",
        }
    }

    fn consume(&mut self, frame: &Arc<Frame>) -> Result<(), SinkError> {
        let text = match self.format {
            TraceFormat::Table => self.row(frame),
            TraceFormat::Events => self.events(frame),
        };
        self.write(&text)
    }

    fn finish(&mut self) -> Result<(), SinkError> {
        if self.format == TraceFormat::Events {
            self.write("\n]\n")?;
        }
        self.file
            .flush()
            .map_err(|error| SinkError(format!("cannot write {}: {error}", self.path.display())))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frame::{FrameId, StageTiming};
    use crate::image::pool::Pool;

    fn frames() -> Vec<Arc<Frame>> {
        let at = |ms: i64| Timestamp(ms * 1_000_000);
        (0..2)
            .map(|number| {
                let mut frame = Frame::new(FrameId(number), at(100), at(101), Pool::new(1).take(2, 2));
                for (stage, entered, left, bypassed) in [("one", 102, 105, false), ("two", 105, 109, number == 1)] {
                    frame.timings.push(StageTiming {
                        stage,
                        entered: at(entered),
                        left: at(left),
                        bypassed,
                    });
                }
                Arc::new(frame)
            })
            .collect()
    }

    fn written(format: TraceFormat) -> String {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("trace");
        let mut sink = TraceSink::new(&path, format, vec!["one", "two"]).unwrap();
        for frame in frames() {
            sink.consume(&frame).unwrap();
        }
        sink.finish().unwrap();
        std::fs::read_to_string(path).unwrap()
    }

    #[test]
    fn a_table_has_a_line_a_frame() {
        let text = written(TraceFormat::Table);
        let lines: Vec<&str> = text.lines().collect();
        assert_eq!(lines[0], "frame,exposed_s,arrived_s,untouched,line_ms,one_ms,two_ms");
        assert!(
            lines[1].starts_with("0,0.1") && lines[1].ends_with(",0,8.000,3.000,4.000"),
            "{}",
            lines[1]
        );
        assert!(lines[2].ends_with(",3.000,"), "{}", lines[2]);
    }

    #[test]
    fn a_trace_is_json_with_an_event_a_frame_and_stage() {
        let events: serde_json::Value = serde_json::from_str(&written(TraceFormat::Events)).unwrap();
        let events = events.as_array().unwrap();
        assert_eq!(events.iter().filter(|event| event["ph"] == "X").count(), 4);
        let last = events.last().unwrap();
        assert_eq!(
            (last["name"].as_str(), last["dur"].as_f64()),
            (Some("1 passed by"), Some(4000.0))
        );
        assert_eq!(last["ts"].as_f64(), Some(105_000.0));
    }
}
