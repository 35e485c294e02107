//! What comes in at the other end: whether there is a signal, its size, and word of its change.

use std::io;

use v4l::device::Handle;
use v4l::v4l_sys::{
    V4L2_EVENT_SOURCE_CHANGE, V4L2_EVENT_SRC_CH_RESOLUTION, v4l2_dv_timings, v4l2_event, v4l2_event_subscription, v4l2_input,
};
use v4l::v4l2::vidioc::{_IOC_TYPE, VIDIOC_ENUMINPUT, VIDIOC_G_INPUT};

use crate::video4linux::ioctl::{Argument as _, Direction, call, request};

const VIDIOC_S_DV_TIMINGS: _IOC_TYPE = request::<v4l2_dv_timings>(Direction::Both, 87);
const VIDIOC_G_DV_TIMINGS: _IOC_TYPE = request::<v4l2_dv_timings>(Direction::Both, 88);
const VIDIOC_DQEVENT: _IOC_TYPE = request::<v4l2_event>(Direction::Read, 89);
const VIDIOC_SUBSCRIBE_EVENT: _IOC_TYPE = request::<v4l2_event_subscription>(Direction::Write, 90);
const VIDIOC_QUERY_DV_TIMINGS: _IOC_TYPE = request::<v4l2_dv_timings>(Direction::Read, 99);

/// Bits of an input's status (`V4L2_IN_ST_…`).
const NO_POWER: u32 = 1;
const NO_SIGNAL: u32 = 2;
const NO_SYNC: u32 = 0x1_0000;

/// Whether a picture comes in; `None` when the driver does not say.
pub fn is_there(handle: &Handle) -> Option<bool> {
    let mut index: i32 = 0;
    call(handle, VIDIOC_G_INPUT, &mut index).ok()?;
    let mut input = v4l2_input::zeroed();
    input.index = u32::try_from(index).ok()?;
    call(handle, VIDIOC_ENUMINPUT, &mut input).ok()?;
    Some(input.status & (NO_POWER | NO_SIGNAL | NO_SYNC) == 0)
}

/// Columns and rows of timings.
fn size_of_timings(timings: &v4l2_dv_timings) -> (usize, usize) {
    #[expect(unsafe_code, reason = "timings are a union of one kind")]
    // SAFETY: the other member is an array of plain integers of at least this size, so whatever is there is a valid `bt`.
    let bt = unsafe { timings.__bindgen_anon_1.bt };
    (bt.width as usize, bt.height as usize)
}

/// Set a capture card to the signal that comes in, if it is of a kind that has timings; its columns and rows. Cameras have none, and
/// when nothing comes in the card stays as it was.
pub fn follow(handle: &Handle) -> Option<(usize, usize)> {
    let mut set = v4l2_dv_timings::zeroed();
    call(handle, VIDIOC_G_DV_TIMINGS, &mut set).ok()?;
    let mut found = v4l2_dv_timings::zeroed();
    if call(handle, VIDIOC_QUERY_DV_TIMINGS, &mut found).is_err() {
        return Some(size_of_timings(&set));
    }
    let size = size_of_timings(&found);
    if size == size_of_timings(&set) {
        return Some(size);
    }
    match call(handle, VIDIOC_S_DV_TIMINGS, &mut found) {
        Ok(()) => Some(size),
        Err(error) => {
            tracing::warn!(
                "camera: a signal of {}x{} comes in, and the card cannot be set to it ({error})",
                size.0,
                size.1
            );
            Some(size_of_timings(&set))
        }
    }
}

/// Ask to be told when another signal comes in. Cameras refuse.
pub fn tell_changes(handle: &Handle) -> io::Result<()> {
    let mut wanted = v4l2_event_subscription::zeroed();
    wanted.type_ = V4L2_EVENT_SOURCE_CHANGE;
    call(handle, VIDIOC_SUBSCRIBE_EVENT, &mut wanted)
}

/// So many events are taken at once.
const MOST_EVENTS: usize = 64;

/// True when word of another signal has come since the last time.
pub fn has_changed(handle: &Handle) -> bool {
    let mut changed = false;
    for _ in 0..MOST_EVENTS {
        let mut event = v4l2_event::zeroed();
        // None left is an error as well.
        if call(handle, VIDIOC_DQEVENT, &mut event).is_err() {
            break;
        }
        #[expect(unsafe_code, reason = "an event is a union of kinds")]
        // SAFETY: the kind says which member is there, and each is plain integers.
        let changes = unsafe { event.u.src_change.changes };
        changed |= event.type_ == V4L2_EVENT_SOURCE_CHANGE && changes & V4L2_EVENT_SRC_CH_RESOLUTION != 0;
    }
    changed
}
