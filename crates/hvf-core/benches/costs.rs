//! Throughput of image costs, beside what the machine can read in the same run.
//!
//! `read` sums the same number of bytes as the pairs hold; costs are worth comparing with it.

use criterion::{criterion_group, criterion_main, BenchmarkId, Criterion, Throughput};
use hvf_core::image::{all_pairs_costs, paired_costs, GaussianBlur};
use ndarray::{s, Array4};
use rayon::prelude::*;

/// Pairs of 64 x 64 x 3 frames in `u8`: 2 x 48 MiB, more than the caches hold.
const PAIRS: usize = 4096;

fn frames(n: usize, seed: u64) -> Array4<u8> {
    let mut state = seed;
    Array4::from_shape_simple_fn((n, 64, 64, 3), || {
        state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (state >> 56) as u8
    })
}

fn read(values: &[u8]) -> u64 {
    let words = |bytes: &[u8]| {
        let (chunks, _) = bytes.as_chunks::<8>();
        chunks.iter().fold(0, |sum, &word| sum ^ u64::from_ne_bytes(word))
    };
    values.par_chunks(1 << 18).map(words).reduce(|| 0, |x, y| x ^ y)
}

fn costs(criterion: &mut Criterion) {
    let (a, b) = (frames(PAIRS, 1), frames(PAIRS, 2));
    let unit = |x: &Array4<u8>| x.slice(s![..PAIRS / 4, .., .., ..]).mapv(|v| f32::from(v) / 255.0);
    let (a_unit, b_unit) = (unit(&a), unit(&b));
    let bytes = 2 * a.len() as u64;
    let mut group = criterion.benchmark_group("image_cost");
    group.sample_size(20);

    group.throughput(Throughput::Bytes(bytes));
    let slices = (a.as_slice().unwrap_or(&[]), b.as_slice().unwrap_or(&[]));
    group.bench_function("read", |bench| bench.iter(|| read(slices.0) ^ read(slices.1)));
    group.bench_function("pairs/u8", |bench| {
        bench.iter(|| paired_costs(a.view(), b.view(), None));
    });
    group.bench_function("pairs/f32", |bench| {
        bench.iter(|| paired_costs(a_unit.view(), b_unit.view(), None));
    });
    group.throughput(Throughput::Bytes(bytes / 2));
    group.bench_function("one_to_many/u8", |bench| {
        bench.iter(|| all_pairs_costs(a.slice(s![..1, .., .., ..]), b.view(), None));
    });

    for sigma in [1.0, 3.0] {
        let blur = GaussianBlur::new(sigma, "blur").unwrap_or(None);
        let (a, b) = (a.slice(s![..512, .., .., ..]), b.slice(s![..512, .., .., ..]));
        group.throughput(Throughput::Elements(512));
        group.bench_function(BenchmarkId::new("pairs/u8/blur", sigma), |bench| {
            bench.iter(|| paired_costs(a, b, blur.as_ref()));
        });
    }

    group.throughput(Throughput::Elements(512 * 512));
    group.bench_function("all_pairs/u8", |bench| {
        let (a, b) = (a.slice(s![..512, .., .., ..]), b.slice(s![..512, .., .., ..]));
        bench.iter(|| all_pairs_costs(a, b, None));
    });
    group.bench_function("all_pairs/f32", |bench| {
        let (a, b) = (a_unit.slice(s![..512, .., .., ..]), b_unit.slice(s![..512, .., .., ..]));
        bench.iter(|| all_pairs_costs(a, b, None));
    });
    group.finish();
}

criterion_group!(benches, costs);
criterion_main!(benches);
