//! One call of the kernel's, for all that have an argument of a plain type.

use std::io;

use v4l::device::Handle;
use v4l::v4l2::ioctl;
use v4l::v4l2::vidioc::_IOC_TYPE;

/// What a request does with its argument.
#[derive(Clone, Copy, Debug)]
pub(super) enum Direction {
    Write = 1,
    Read = 2,
    Both = 3,
}

/// A request's number as `<linux/videodev2.h>` makes it: direction, size of the argument, the letter V, a running number.
pub(super) const fn request<T>(direction: Direction, number: u8) -> _IOC_TYPE {
    (direction as _IOC_TYPE) << 30 | (size_of::<T>() as _IOC_TYPE) << 16 | (b'V' as _IOC_TYPE) << 8 | number as _IOC_TYPE
}

/// Arguments of requests: plain data of the kernel's, for which all zeros are valid.
pub(super) trait Argument: Copy {
    /// All zeros.
    fn zeroed() -> Self;
}

macro_rules! plain {
    ($($argument:ty),+) => {$(
        impl Argument for $argument {
            #[expect(unsafe_code, reason = "the crate's bindings have no default")]
            fn zeroed() -> Self {
                // SAFETY: a C structure of integers and unions of integers, for which all zeros are valid.
                unsafe { std::mem::zeroed() }
            }
        }
    )+};
}

plain!(
    i32,
    v4l::v4l_sys::v4l2_input,
    v4l::v4l_sys::v4l2_event,
    v4l::v4l_sys::v4l2_event_subscription,
    v4l::v4l_sys::v4l2_dv_timings,
    v4l::v4l_sys::v4l2_requestbuffers,
    v4l::v4l_sys::v4l2_buffer
);

/// Make the request. `number` must be made for arguments of this type, by [`request`] or by the crate.
pub(super) fn call<T: Argument>(handle: &Handle, number: _IOC_TYPE, argument: &mut T) -> io::Result<()> {
    debug_assert_eq!((number >> 16) & 0x3fff, size_of::<T>() as _IOC_TYPE);
    #[expect(unsafe_code, reason = "the crate has no safe call for these requests")]
    // SAFETY: the request's number says how large its argument is, which is what it is given; it lives until the call returns, and
    // the kernel keeps no pointer to it.
    unsafe {
        ioctl(handle.fd(), number, std::ptr::from_mut(argument).cast())
    }
}
