//! The segments of a batch of ways, from a start over `K` subgoals to a goal, as planning problems.
//!
//! A model's starts and goals are put together and prepared once, whatever is planned of them
//! later, and in as few batches as the model's memory allows. Segment `k` of way `w` has the number
//! `w * (K + 1) + k`.

use super::segment_stream;
use crate::planner::model::{Frames, WorldModel};
use crate::planner::mpc::{prepared, probe, solve, Interrupt, MpcConfig, Plan, Problems};
use crate::planner::sampler::Stream;
use crate::Result;

/// Ways between one start and one goal.
pub(super) struct Ways<'a, F> {
    /// Where they start, one frame.
    pub start: &'a F,
    /// What they should reach, one frame.
    pub goal: &'a F,
    /// Subgoals of `M` ways, way after way, `[M * K]`.
    pub subgoals: F,
    /// Seed of their plans.
    pub seed: u64,
}

/// With what segments are planned.
pub(super) struct Planner<'a, W> {
    pub mpc: &'a MpcConfig,
    pub world: &'a W,
    /// Share the first iteration's rollouts of segments with one start.
    pub share_rollouts: bool,
    pub interrupt: Interrupt<'a>,
}

impl<W> Clone for Planner<'_, W> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<W> Copy for Planner<'_, W> {}

/// A batch of segments: starts (one for each, or one for all) and goals, and their numbers.
struct Part<F> {
    starts: F,
    goals: F,
    numbers: Vec<usize>,
}

/// Segments, prepared.
pub(super) struct Segments<'a, W: WorldModel> {
    planner: Planner<'a, W>,
    parts: Vec<Part<W::Frames>>,
    /// Part of each segment, and its place there.
    places: Vec<(usize, usize)>,
    streams: Vec<Stream>,
    describe: &'a dyn Fn(usize) -> String,
}

impl<'a, W: WorldModel> Segments<'a, W> {
    /// All segments of `ways` over `subgoals` images each; plans of iteration `iteration` have
    /// random numbers of their own. `describe` says what to call a segment in an error.
    ///
    /// # Errors
    /// Whatever keeps the model's memory or its [`prepare`](WorldModel::prepare) from answering.
    pub fn new(
        planner: Planner<'a, W>,
        ways: &[Ways<'_, W::Frames>],
        subgoals: usize,
        iteration: usize,
        describe: &'a dyn Fn(usize) -> String,
    ) -> Result<Self> {
        let (mut first, mut later, mut streams) = (Vec::new(), Vec::new(), Vec::new());
        for group in ways {
            let count = group.subgoals.len() / subgoals;
            let begin = streams.len();
            let numbers = |segment: usize| -> Vec<usize> {
                (0..count).map(|way| begin + way * (subgoals + 1) + segment).collect()
            };
            let images = |number: usize| (0..count).map(move |way| way * subgoals + number);
            let starts = group.start.clone();
            let goals = group.subgoals.select(&images(0).collect::<Vec<_>>())?;
            first.push(Part { starts, goals, numbers: numbers(0) });
            let between = |offset: usize| -> Vec<usize> {
                (1..subgoals).flat_map(|number| images(number - offset)).collect()
            };
            if subgoals > 1 {
                later.push(Part {
                    starts: group.subgoals.select(&between(1))?,
                    goals: group.subgoals.select(&between(0))?,
                    numbers: (1..subgoals).flat_map(numbers).collect(),
                });
            }
            later.push(Part {
                starts: group.subgoals.select(&images(subgoals - 1).collect::<Vec<_>>())?,
                goals: group.goal.select(&vec![0; count])?,
                numbers: numbers(subgoals),
            });
            for way in 0..count {
                streams.extend(
                    (0..=subgoals).map(|number| segment_stream(group.seed, iteration, way, number)),
                );
            }
        }
        let parts = if planner.share_rollouts {
            first.into_iter().chain(joined(later)?).collect()
        } else {
            let each = first.into_iter().map(|part| {
                let starts = part.starts.select(&vec![0; part.numbers.len()])?;
                Ok(Part { starts, ..part })
            });
            joined(each.chain(later.into_iter().map(Ok)).collect::<Result<_>>()?)?
        };
        let mut places = vec![(0, 0); streams.len()];
        for (number, part) in parts.iter().enumerate() {
            for (place, &segment) in part.numbers.iter().enumerate() {
                places[segment] = (number, place);
            }
        }
        let ready = |part: Part<W::Frames>| {
            Ok(match prepared(planner.world, &part.starts, &part.goals)? {
                Some((starts, goals)) => Part { starts, goals, ..part },
                None => part,
            })
        };
        let parts = parts.into_iter().map(ready).collect::<Result<_>>()?;
        Ok(Self { planner, parts, places, streams, describe })
    }

    /// How many there are.
    pub fn len(&self) -> usize {
        self.places.len()
    }

    /// Plans of the segments `which`, in that order. Where a cost is `enough` for one, its plan may
    /// be any that costs no more.
    ///
    /// # Errors
    /// As [`plan`](crate::planner::mpc::plan).
    pub fn plan(&self, which: &[usize], enough: Option<&[f32]>) -> Result<Vec<Plan>> {
        let Planner { mpc, world, interrupt, .. } = self.planner;
        self.for_parts(which, |members, problems| {
            let enough = enough.map(|costs| members.iter().map(|&m| costs[m]).collect::<Vec<_>>());
            solve(mpc, world, problems, enough.as_deref(), interrupt)
        })
    }

    /// Plans of all segments.
    ///
    /// # Errors
    /// As [`plan`](crate::planner::mpc::plan).
    pub fn plan_all(&self) -> Result<Vec<Plan>> {
        self.plan(&(0..self.len()).collect::<Vec<_>>(), None)
    }

    /// Guesses of what all segments cost, which say little more than which one is hard.
    ///
    /// # Errors
    /// As [`plan`](crate::planner::mpc::plan).
    pub fn probe(&self) -> Result<Vec<f32>> {
        let Planner { mpc, world, interrupt, .. } = self.planner;
        let all: Vec<usize> = (0..self.len()).collect();
        self.for_parts(&all, |_, problems| probe(mpc, world, problems, interrupt))
    }

    /// What `work` gives for the segments `which`, part by part; it gets the places in `which`.
    fn for_parts<T>(
        &self,
        which: &[usize],
        work: impl Fn(&[usize], &Problems<'_, W::Frames>) -> Result<Vec<T>>,
    ) -> Result<Vec<T>> {
        let mut found: Vec<Option<T>> = which.iter().map(|_| None).collect();
        for (number, part) in self.parts.iter().enumerate() {
            let members: Vec<usize> =
                (0..which.len()).filter(|&m| self.places[which[m]].0 == number).collect();
            if members.is_empty() {
                continue;
            }
            let index: Vec<usize> = members.iter().map(|&m| self.places[which[m]].1).collect();
            let streams: Vec<Stream> = members.iter().map(|&m| self.streams[which[m]]).collect();
            let starts = match part.starts.len() {
                1 => part.starts.clone(),
                _ => part.starts.select(&index)?,
            };
            let problems = Problems {
                starts: &starts,
                goals: &part.goals.select(&index)?,
                streams: &streams,
                warm_start: None,
                share_rollouts: self.planner.share_rollouts,
                describe: &|problem| (self.describe)(which[members[problem]]),
            };
            for (&member, result) in members.iter().zip(work(&members, &problems)?) {
                found[member] = Some(result);
            }
        }
        Ok(found.into_iter().map(|one| one.expect("every segment is in a part")).collect())
    }
}

/// The parts as one, where the frames can be joined.
fn joined<F: Frames>(parts: Vec<Part<F>>) -> Result<Vec<Part<F>>> {
    if parts.len() < 2 {
        return Ok(parts);
    }
    let starts: Vec<&F> = parts.iter().map(|part| &part.starts).collect();
    let goals: Vec<&F> = parts.iter().map(|part| &part.goals).collect();
    let (Some(starts), Some(goals)) = (F::join(&starts), F::join(&goals)) else {
        return Ok(parts);
    };
    let numbers = parts.iter().flat_map(|part| part.numbers.iter().copied()).collect();
    Ok(vec![Part { starts: starts?, goals: goals?, numbers }])
}
