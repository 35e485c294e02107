//! Video files: the only room that calls libav.
//!
//! Pictures come in from video files, numbered images or a y4m stream and are handed on as 8-bit RGB with the exact time
//! stamps of their container; they go out the same ways. Colour is converted by the tags of the file (matrix and range),
//! and nowhere else in the house is anything but RGB seen.

pub mod color;
pub mod container_reader;
pub mod container_writer;
pub mod error;
pub mod filter;
pub mod frame_index;
pub mod image_files;
pub mod layout;
pub mod libav;
pub mod reader;
pub mod sound;
pub mod truncation;
pub mod writer;
pub mod y4m;
