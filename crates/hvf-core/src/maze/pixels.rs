//! Pixels of square frames: which an interval covers and by how much, and intervals found again in
//! what pixels show of them.

use std::ops::Range;

use super::render::VIEW;

/// Pixels that the agent covers.
pub(super) struct Covered {
    /// Rows that it reaches into.
    pub rows: Range<usize>,
    /// Columns that it reaches into.
    pub columns: Range<usize>,
    /// The part of the first and the last row that it covers; it covers all of those between.
    pub row_ends: [f64; 2],
    /// The same for columns.
    pub column_ends: [f64; 2],
}

impl Covered {
    /// The part of `pixel` that an interval over `pixels` with these `ends` covers.
    #[inline]
    pub fn part(pixel: usize, pixels: &Range<usize>, ends: [f64; 2]) -> f64 {
        if pixel == pixels.start {
            ends[0]
        } else if pixel + 1 == pixels.end {
            ends[1]
        } else {
            1.0
        }
    }
}

/// One axis of a frame: `size` pixels over `[-VIEW, VIEW]`.
#[derive(Clone, Copy)]
pub(super) struct Axis {
    size: usize,
}

impl Axis {
    pub fn new(size: usize) -> Self {
        Self { size }
    }

    pub fn size(self) -> usize {
        self.size
    }

    /// What a pixel of a square frame shows: `[[low x, high x], [low y, high y]]`, m.
    pub fn rectangle(self, pixel: usize) -> [[f64; 2]; 2] {
        let (row, col) = (pixel / self.size, pixel % self.size);
        [[self.edge(col), self.edge(col + 1)], [-self.edge(row + 1), -self.edge(row)]]
    }

    /// Width of a pixel, m.
    #[inline]
    pub fn pixel(self) -> f64 {
        2.0 * VIEW / self.size as f64
    }

    /// Where pixel `index` begins.
    #[inline]
    pub fn edge(self, index: usize) -> f64 {
        index as f64 * self.pixel() - VIEW
    }

    /// The pixels that `[low, high]` overlaps.
    #[inline]
    pub fn pixels(self, low: f64, high: f64) -> Range<usize> {
        let scale = self.size as f64 / (2.0 * VIEW);
        let first = ((low + VIEW) * scale).floor().max(0.0) as usize;
        let last = ((high + VIEW) * scale).ceil().clamp(0.0, self.size as f64) as usize;
        first..last
    }

    /// The part of pixel `index` that `[low, high]` covers.
    #[inline]
    pub fn covered(self, index: usize, low: f64, high: f64) -> f64 {
        let scale = self.size as f64 / (2.0 * VIEW);
        let begin = (low + VIEW) * scale - index as f64;
        let end = (high + VIEW) * scale - index as f64;
        (end.min(1.0) - begin.max(0.0)).clamp(0.0, 1.0)
    }

    /// Whole pixels that an interval of `2 * half` fits into.
    pub fn window(self, half: f64) -> usize {
        ((2.0 * half / self.pixel() - 1e-9).ceil() as usize).clamp(1, self.size)
    }

    /// Centre of the interval of `2 * half` metres whose coverage of the pixels is `profile`, up
    /// to a factor.
    ///
    /// What lies on either side of a pixel edge inside the interval says how far the interval
    /// extends there.
    pub fn centre(self, profile: &[f64], half: f64) -> f64 {
        let window = self.window(half);
        let sums =
            |first: usize| profile[first..(first + window).min(self.size)].iter().sum::<f64>();
        let mut best = (f64::NEG_INFINITY, 0);
        for first in 0..=self.size - window {
            let sum = sums(first);
            if sum > best.0 + 1e-9 {
                best = (sum, first);
            }
        }
        let (low, high) = (best.1.saturating_sub(1), (best.1 + window + 1).min(self.size));
        let near = &profile[low..high];
        let total: f64 = near.iter().sum();
        if total <= 1e-6 {
            return 0.0;
        }
        // The edge with about half of the coverage on each side.
        let (mut before, mut split) = (0.0, 0);
        while split + 1 < near.len()
            && (before + near[split] - 0.5 * total).abs() <= (before - 0.5 * total).abs()
        {
            before += near[split];
            split += 1;
        }
        let balance = (total - 2.0 * before) / total;
        self.edge(low + split) + balance * half
    }

    /// First row and column of the square window of the size of an object of half-size `half`
    /// that holds most of `image`, `[size, size]`.
    pub fn brightest_window(self, image: &[f64], half: f64) -> (usize, usize) {
        let (size, window) = (self.size, self.window(half));
        let mut columns = vec![0.0; size];
        for row in 0..window {
            for col in 0..size {
                columns[col] += image[row * size + col];
            }
        }
        let mut best = (f64::NEG_INFINITY, 0, 0);
        for row in 0..=size - window {
            if row > 0 {
                for col in 0..size {
                    columns[col] +=
                        image[(row + window - 1) * size + col] - image[(row - 1) * size + col];
                }
            }
            let mut sum: f64 = columns[..window].iter().sum();
            for col in 0..=size - window {
                if col > 0 {
                    sum += columns[col + window - 1] - columns[col - 1];
                }
                if sum > best.0 + 1e-9 {
                    best = (sum, row, col);
                }
            }
        }
        (best.1, best.2)
    }
}
