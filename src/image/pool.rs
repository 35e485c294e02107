//! A pool of images: taking one costs nothing once the line runs, dropping one gives it back.
//!
//! The free list is bounded by what was ever in flight at once, so a line with bounded queues holds bounded memory.

use std::ops::{Deref, DerefMut};
use std::sync::Arc;

use crossbeam::queue::ArrayQueue;

use crate::image::buffer::Image;

/// Images of one pixel type, kept for reuse.
#[derive(Debug)]
pub struct Pool<P> {
    free: Arc<ArrayQueue<Image<P>>>,
}

impl<P> Clone for Pool<P> {
    fn clone(&self) -> Self {
        Self {
            free: Arc::clone(&self.free),
        }
    }
}

impl<P: Copy + Default> Pool<P> {
    /// A pool that keeps at most `kept` images; more may be in flight, the surplus is freed when dropped.
    pub fn new(kept: usize) -> Self {
        Self {
            free: Arc::new(ArrayQueue::new(kept.max(1))),
        }
    }

    /// An image of the given size with unspecified content; allocates only when no kept one is large enough.
    pub fn take(&self, width: usize, height: usize) -> Pooled<P> {
        let mut image = self.free.pop().unwrap_or_else(|| Image::filled(0, 0, P::default()));
        if image.size() != (width, height) {
            image.resize(width, height, P::default());
        }
        Pooled {
            image,
            home: Arc::clone(&self.free),
        }
    }

    /// A copy of `source` in a pooled image.
    pub fn take_copy(&self, source: &Image<P>) -> Pooled<P> {
        let mut copy = self.free.pop().unwrap_or_else(|| Image::filled(0, 0, P::default()));
        copy.copy_from(source);
        Pooled {
            image: copy,
            home: Arc::clone(&self.free),
        }
    }
}

/// An image on loan from a [`Pool`]; goes back when dropped.
#[derive(Debug)]
pub struct Pooled<P: Copy> {
    image: Image<P>,
    home: Arc<ArrayQueue<Image<P>>>,
}

impl<P: Copy> Pooled<P> {
    /// Swap contents with a buffer of the stage's own: how a stage hands its result in as its last act.
    pub fn swap(&mut self, other: &mut Image<P>) {
        std::mem::swap(&mut self.image, other);
    }
}

impl<P: Copy> Deref for Pooled<P> {
    type Target = Image<P>;
    fn deref(&self) -> &Image<P> {
        &self.image
    }
}

impl<P: Copy> DerefMut for Pooled<P> {
    fn deref_mut(&mut self) -> &mut Image<P> {
        &mut self.image
    }
}

impl<P: Copy> Drop for Pooled<P> {
    fn drop(&mut self) {
        if let Some(image) = Image::from_vec(0, 0, Vec::new()) {
            let image = std::mem::replace(&mut self.image, image);
            // A full pool is no error: the surplus image is simply freed.
            let _surplus = self.home.push(image);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_dropped_image_is_taken_again() {
        let pool = Pool::<u8>::new(2);
        let first = pool.take(4, 3);
        let address = first.pixels().as_ptr();
        drop(first);
        assert_eq!(pool.take(4, 3).pixels().as_ptr(), address);
    }

    #[test]
    fn another_size_is_served() {
        let pool = Pool::<u8>::new(2);
        drop(pool.take(4, 3));
        assert_eq!(pool.take(2, 2).size(), (2, 2));
    }
}
