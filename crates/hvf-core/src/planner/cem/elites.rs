//! Which candidates are the elites: the order of costs.

use ndarray::ArrayView1;

/// Places of the `count` lowest costs in the list `kept ++ costs`, ordered by (cost, place).
/// NaN is never an elite, so there may be fewer.
pub(in crate::planner) fn elites(
    kept: &[f32],
    costs: ArrayView1<'_, f32>,
    count: usize,
) -> Vec<usize> {
    let mut keys: Vec<u64> = kept
        .iter()
        .chain(costs.iter())
        .enumerate()
        .map(|(place, &cost)| u64::from(sortable(cost)) << 32 | place as u64)
        .collect();
    if count < keys.len() {
        keys.select_nth_unstable(count - 1);
        keys.truncate(count);
    }
    keys.sort_unstable();
    keys.into_iter()
        .take_while(|key| (key >> 32) as u32 != NAN_KEY)
        .map(|key| (key & u64::from(u32::MAX)) as usize)
        .collect()
}

const NAN_KEY: u32 = u32::MAX;

/// An integer in the order of the costs: both zeros equal, NaN last.
fn sortable(cost: f32) -> u32 {
    if cost.is_nan() {
        return NAN_KEY;
    }
    let bits = (cost + 0.0).to_bits();
    if bits >> 31 == 1 {
        !bits
    } else {
        bits | 1 << 31
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn elites_are_the_first_of_a_stable_sort(
            costs in prop::collection::vec(
                prop_oneof![-2i8..3, Just(7i8), Just(8), Just(9)].prop_map(|code| match code {
                    7 => f32::NAN,
                    8 => f32::INFINITY,
                    9 => -0.0,
                    value => f32::from(value),
                }),
                1..60,
            ),
            kept in 0usize..5,
            count in 1usize..20,
        ) {
            let kept = kept.min(costs.len());
            let (old, new) = costs.split_at(kept);
            let mut expected: Vec<usize> = (0..costs.len()).filter(|&i| !costs[i].is_nan()).collect();
            expected.sort_by(|&a, &b| costs[a].partial_cmp(&costs[b]).unwrap());
            expected.truncate(count);
            prop_assert_eq!(elites(old, ArrayView1::from(new), count), expected);
        }
    }
}
