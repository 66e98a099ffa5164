//! What the cell sees around every point of a scene, computed once for the scene.
//!
//! The cell's first layer looks at a patch of the scene around the keypoint. It is linear in the
//! scene, so at whole pixels it is a convolution, and between pixels it is the bilinear
//! interpolation of that convolution, to the last term: patches, too, are read bilinearly. A
//! candidate therefore pays four multiply-adds per hidden unit instead of one per pixel of the
//! patch.

/// First-layer features of a scene at every whole pixel, `[S, S, hidden]`.
#[derive(Clone, Debug)]
pub struct SceneField {
    size: usize,
    hidden: usize,
    features: Vec<f32>,
}

impl SceneField {
    /// Convolves a scene `map[S, S]` (`map` holds its rows one after the other) with the first
    /// layer: `patch[taps * taps][hidden]`, `bias[hidden]`, taps `spacing` pixels apart. Outside
    /// the scene its border goes on.
    ///
    /// `S^2 * taps^2 * hidden` multiply-adds.
    pub(super) fn new(
        map: &[f32],
        size: usize,
        patch: &[f32],
        bias: &[f32],
        spacing: usize,
    ) -> Self {
        let hidden = bias.len();
        let mut features = vec![0.0; size * size * hidden];
        convolve(map, size, patch, bias, spacing, &mut features);
        Self { size, hidden, features }
    }

    /// Writes the features at a point (row, column in pixels, moved into the scene) into
    /// `out[hidden]`.
    #[inline(always)]
    pub(super) fn sample(&self, point: [f32; 2], out: &mut [f32]) {
        let last = (self.size - 1) as f32;
        let [y, x] = point.map(|p| p.clamp(0.0, last));
        // The upper neighbour of the last pixel counts with weight zero; stay inside.
        let (top, left) = ((y as usize).min(self.size - 2), (x as usize).min(self.size - 2));
        let (down, right) = (y - top as f32, x - left as f32);
        let corner =
            |r: usize, c: usize| &self.features[(r * self.size + c) * self.hidden..][..self.hidden];
        let (a, b) = (corner(top, left), corner(top, left + 1));
        let (c, d) = (corner(top + 1, left), corner(top + 1, left + 1));
        let weights = [
            (1.0 - down) * (1.0 - right),
            (1.0 - down) * right,
            down * (1.0 - right),
            down * right,
        ];
        for ((((sum, a), b), c), d) in out.iter_mut().zip(a).zip(b).zip(c).zip(d) {
            let upper = weights[1].mul_add(*b, weights[0] * a);
            *sum = weights[3].mul_add(*d, weights[2].mul_add(*c, upper));
        }
    }
}

#[multiversion::multiversion(targets("x86_64+avx2+fma"))]
fn convolve(
    map: &[f32],
    size: usize,
    patch: &[f32],
    bias: &[f32],
    spacing: usize,
    features: &mut [f32],
) {
    let hidden = bias.len();
    let taps = (patch.len() / hidden).isqrt();
    let reach = (taps / 2 * spacing) as isize;
    let last = size as isize - 1;
    let at = |position: usize, tap: usize| -> usize {
        (position as isize + (tap * spacing) as isize - reach).clamp(0, last) as usize
    };
    for (pixel, here) in features.chunks_exact_mut(hidden).enumerate() {
        let (row, column) = (pixel / size, pixel % size);
        here.copy_from_slice(bias);
        for tap_row in 0..taps {
            let line = &map[at(row, tap_row) * size..][..size];
            for tap_column in 0..taps {
                let value = line[at(column, tap_column)];
                let weights = &patch[(tap_row * taps + tap_column) * hidden..][..hidden];
                for (sum, &weight) in here.iter_mut().zip(weights) {
                    *sum = weight.mul_add(value, *sum);
                }
            }
        }
    }
}
