//! A dense image: rows one after the other, no padding; pixel (0, 0) is the centre of the top-left pixel.

/// Red, green, blue; 8-bit sRGB.
pub type Rgb8 = [u8; 3];

/// One value a pixel, by convention 0 = no.
pub type Mask = Image<u8>;

/// A dense `width` × `height` image, row-major.
#[derive(Clone, Debug, PartialEq)]
pub struct Image<P> {
    width: usize,
    height: usize,
    data: Vec<P>,
}

impl<P: Copy> Image<P> {
    /// Every pixel the same.
    pub fn filled(width: usize, height: usize, value: P) -> Self {
        Self {
            width,
            height,
            data: vec![value; width * height],
        }
    }

    /// From pixels row by row; `None` if their number is not `width * height`.
    pub fn from_vec(width: usize, height: usize, data: Vec<P>) -> Option<Self> {
        (data.len() == width * height).then_some(Self { width, height, data })
    }

    /// Columns.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Rows.
    pub fn height(&self) -> usize {
        self.height
    }

    /// (columns, rows).
    pub fn size(&self) -> (usize, usize) {
        (self.width, self.height)
    }

    /// All pixels, row by row.
    pub fn pixels(&self) -> &[P] {
        &self.data
    }

    /// All pixels, row by row.
    pub fn pixels_mut(&mut self) -> &mut [P] {
        &mut self.data
    }

    /// One row.
    pub fn row(&self, y: usize) -> &[P] {
        &self.data[y * self.width..(y + 1) * self.width]
    }

    /// One row.
    pub fn row_mut(&mut self, y: usize) -> &mut [P] {
        &mut self.data[y * self.width..(y + 1) * self.width]
    }

    /// The pixel in column `x` of row `y`.
    #[inline]
    pub fn at(&self, x: usize, y: usize) -> P {
        self.data[y * self.width + x]
    }

    /// Set the pixel in column `x` of row `y`.
    #[inline]
    pub fn set(&mut self, x: usize, y: usize, value: P) {
        self.data[y * self.width + x] = value;
    }

    /// Every pixel the same.
    pub fn fill(&mut self, value: P) {
        self.data.fill(value);
    }

    /// Take over another image's size and pixels; allocates only if it must grow.
    pub fn copy_from(&mut self, other: &Self) {
        self.width = other.width;
        self.height = other.height;
        self.data.clear();
        self.data.extend_from_slice(&other.data);
    }

    /// Keep the first `width * height` pixels as an image of that size (a smaller image written into the front of a larger one).
    pub fn crop_rows(&mut self, width: usize, height: usize) {
        self.width = width;
        self.height = height.min(self.data.len() / width.max(1));
        self.data.truncate(self.width * self.height);
    }

    /// Change the size, every pixel `value`; allocates only if it must grow.
    pub fn resize(&mut self, width: usize, height: usize, value: P) {
        self.width = width;
        self.height = height;
        self.data.clear();
        self.data.resize(width * height, value);
    }
}

impl<P: bytemuck::Pod> Image<P> {
    /// The pixels as bytes.
    pub fn as_bytes(&self) -> &[u8] {
        bytemuck::cast_slice(&self.data)
    }

    /// The pixels as bytes.
    pub fn as_bytes_mut(&mut self) -> &mut [u8] {
        bytemuck::cast_slice_mut(&mut self.data)
    }
}
