//! Planner throughput: the cross-entropy method's own work (sampling, selection, refit) with an
//! objective that costs nothing.
use criterion::{criterion_group, criterion_main, Criterion, Throughput};
use hvf_core::planner::cem::{minimise, Call, CemConfig, Objective};
use hvf_core::planner::distribution::{Bounds, Initial};
use hvf_core::planner::sampler::{Purpose, Stream};
use hvf_core::Result;
use ndarray::{Array2, Array3};

const PROBLEMS: usize = 600;
const DIMENSIONS: usize = 10;

/// Costs fixed beforehand, whatever the candidates.
struct Free {
    costs: Array2<f32>,
}

impl Objective for Free {
    fn costs(&mut self, _call: Call<'_>, _candidates: Array3<f32>) -> Result<Array2<f32>> {
        Ok(self.costs.clone())
    }
}

fn cem_own_work(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("cem_own_work");
    group.sample_size(20);
    let config = CemConfig { min_variance: 0.0, ..CemConfig::default() };
    let costs = Array2::from_shape_fn((PROBLEMS, config.samples), |(problem, sample)| {
        ((problem * 7919 + sample * 104_729) % 100_003) as f32
    });
    let bounds = Bounds { low: vec![-3.0; DIMENSIONS], high: vec![3.0; DIMENSIONS] };
    let streams: Vec<Stream> = (0..PROBLEMS as u64)
        .map(|problem| Stream { seed: 0, purpose: Purpose::Actions, problem })
        .collect();
    let uniform = Initial::Uniform { low: bounds.low.clone(), high: bounds.high.clone() };
    let candidates = PROBLEMS * config.samples * config.iterations;
    group.throughput(Throughput::Elements(candidates as u64));
    group.bench_function("600_problems_x_200_samples_x_10_dims", |bencher| {
        let mut objective = Free { costs: costs.clone() };
        bencher.iter(|| {
            minimise(&config, &bounds, std::slice::from_ref(&uniform), &streams, &mut objective)
        });
    });
    group.finish();
}

criterion_group!(benches, cem_own_work);
criterion_main!(benches);
