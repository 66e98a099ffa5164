//! The maze as a world model: its true simulator, its renderer and the pixel cost.

use std::sync::Arc;

use ndarray::{Array2, ArrayView2, ArrayView3, ArrayView4, Axis};
use rayon::prelude::*;

use super::agent_cost::{AgentCost, GoalTerms, Patch};
use super::frames::{MazeFrames, States};
use super::geometry::State;
use super::ground::Ground;
use super::layout::Layout;
use super::physics::ACTION_LIMIT;
use super::render::{Renderer, IMAGE_SIZE};
use crate::image::{GaussianBlur, OverHorizon};
use crate::planner::{ActionSpace, Candidates, Frames, SharedCandidates, WorldModel};
use crate::{Error, Result};

/// Candidates that a thread takes at a time.
const CANDIDATES_PER_TASK: usize = 32;

/// Settings of [`MazeWorld`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MazeWorldConfig {
    /// Size of the images, pixels.
    pub image_size: usize,
    /// Standard deviation of the Gaussian blur of frame and goal, pixels; 0 is none.
    pub blur: f64,
    /// Which frames of a rollout count.
    pub over_horizon: OverHorizon,
}

impl Default for MazeWorldConfig {
    /// 64 pixels, no blur, the last frame: the paper's cost.
    fn default() -> Self {
        Self { image_size: IMAGE_SIZE, blur: 0.0, over_horizon: OverHorizon::Last }
    }
}

/// The true simulator as a world model.
///
/// The planning cost is the pixel cost between the frame that the simulator and the renderer
/// would give and the goal image. It is computed without drawing the frame and equals
/// [`paired_costs`](crate::image::paired_costs) of the drawn frame: bit for bit without blur, to
/// 1e-5 with. Actions beyond the action box count as the nearest within, as in the environment.
///
/// # Example
/// ```
/// use hvf_core::maze::{Difficulty, Episode, MazeFrames, MazeWorld, MazeWorldConfig};
/// use hvf_core::planner::WorldModel;
/// use ndarray::Array4;
///
/// let world = MazeWorld::new(MazeWorldConfig::default())?;
/// let episode = Episode::new(0, 0, Difficulty::Easy);
/// let starts = MazeFrames::from_states(vec![episode.start], 64);
/// let goals = MazeFrames::from_states(vec![episode.goal()], 64);
/// let stay = Array4::zeros((1, 10, 5, 2));
/// assert_eq!(world.rollout_costs(&starts, &goals, stay.into())?.dim(), (1, 10));
/// # Ok::<(), hvf_core::Error>(())
/// ```
#[derive(Clone, Debug)]
pub struct MazeWorld {
    config: MazeWorldConfig,
    renderer: Renderer,
    cost: AgentCost,
    actions: ActionSpace,
    layout: Option<Arc<Layout>>,
}

impl MazeWorld {
    /// A world with these settings.
    ///
    /// # Errors
    /// An image size that [`Renderer::new`] refuses, or a blur that is negative or not finite.
    pub fn new(config: MazeWorldConfig) -> Result<Self> {
        let renderer = Renderer::new(config.image_size)?;
        let blur = GaussianBlur::new(config.blur, "blur")?;
        let limit = ACTION_LIMIT as f32;
        Ok(Self {
            config,
            cost: AgentCost::new(&renderer, blur),
            renderer,
            actions: ActionSpace::new(vec![-limit; 2], vec![limit; 2])?,
            layout: None,
        })
    }

    /// The same world of another layout: images are read as showing it. Frames of states have
    /// their layout with them.
    pub fn with_layout(self, layout: Arc<Layout>) -> Self {
        Self { layout: layout.difficulty().is_none().then_some(layout), ..self }
    }

    /// The layout that images show, if it is not the paper's.
    pub fn layout(&self) -> Option<&Arc<Layout>> {
        self.layout.as_ref()
    }

    /// The settings it was made with.
    pub fn config(&self) -> &MazeWorldConfig {
        &self.config
    }

    /// What draws its frames.
    pub fn renderer(&self) -> &Renderer {
        &self.renderer
    }

    /// Frames of images `[N, S, S, 3]`; where a rollout starts is read off them.
    ///
    /// # Errors
    /// Bytes that are not a whole number of images of this world's size.
    pub fn observe(&self, images: &[u8]) -> Result<MazeFrames> {
        match &self.layout {
            None => MazeFrames::from_images(&self.renderer, images),
            Some(layout) => MazeFrames::from_images_in(layout, &self.renderer, images),
        }
    }

    /// States `[D, H]` that `actions[D, H, 2]` lead through from `start`.
    ///
    /// # Errors
    /// Actions of another dimension, or not finite.
    pub fn rollout<S: Ground>(
        &self,
        start: State<S>,
        actions: ArrayView3<'_, f32>,
    ) -> Result<Array2<State<S>>> {
        check_actions(actions.iter(), actions.len_of(Axis(2)))?;
        let (candidates, steps, _) = actions.dim();
        let space = start.scene.space();
        let mut states = Array2::from_elem((candidates, steps), start.clone());
        states.axis_iter_mut(Axis(0)).into_par_iter().enumerate().for_each(|(d, mut row)| {
            let actions = actions.index_axis(Axis(0), d);
            roll(&space, &start, actions, |step, state| row[step].position = state.position);
        });
        Ok(states)
    }

    /// The image of the start's scene without the agent, and what its candidates have in common.
    fn terms<S: Ground>(
        &self,
        start: &State<S>,
        goals: &MazeFrames,
        goal: usize,
    ) -> Result<(Vec<u8>, GoalTerms)> {
        let mut scene = vec![0; self.renderer.frame_len()];
        self.renderer.render_scene(&start.scene, &mut scene);
        let goal = goals.image(&self.renderer, goal)?;
        let terms = self.cost.goal_terms(&scene, &goal);
        Ok((scene, terms))
    }

    fn counts(&self, step: usize, steps: usize) -> bool {
        self.config.over_horizon.counts(step, steps)
    }
}

/// Hands the state after every action of `actions[H, 2]` to `visit(step, state)`.
#[inline]
fn roll<S: Ground>(
    space: &S::Space,
    start: &State<S>,
    actions: ArrayView2<'_, f32>,
    mut visit: impl FnMut(usize, &State<S>),
) {
    let mut state = start.clone();
    for (step, action) in actions.rows().into_iter().enumerate() {
        let action = [f64::from(action[0]), f64::from(action[1])];
        state.position = S::step_from(space, state.position, action);
        visit(step, &state);
    }
}

fn check_dim(dim: usize) -> Result<()> {
    if dim != 2 {
        return Err(Error::invalid("actions", format!("must have 2 dimensions, got {dim}")));
    }
    Ok(())
}

/// Whether a candidate's actions `[H, 2]` are numbers: its cost is NaN where they are not.
fn are_finite(actions: ArrayView2<'_, f32>) -> bool {
    actions.iter().all(|a| a.is_finite())
}

fn check_actions<'a>(mut actions: impl Iterator<Item = &'a f32>, dim: usize) -> Result<()> {
    check_dim(dim)?;
    match actions.find(|a| !a.is_finite()) {
        Some(a) => Err(Error::invalid("actions", format!("must be finite, got {a}"))),
        None => Ok(()),
    }
}

fn check_count(argument: &'static str, frames: &MazeFrames, problems: usize) -> Result<()> {
    if frames.len() == problems {
        return Ok(());
    }
    Err(Error::invalid(
        argument,
        format!("must be as many as the problems in actions ({problems}), got {}", frames.len()),
    ))
}

impl WorldModel for MazeWorld {
    type Frames = MazeFrames;

    fn action_space(&self) -> &ActionSpace {
        &self.actions
    }

    fn rollout_costs(
        &self,
        starts: &MazeFrames,
        goals: &MazeFrames,
        Candidates { actions, .. }: Candidates,
    ) -> Result<Array2<f32>> {
        let (problems, _, _, dim) = actions.dim();
        check_count("starts", starts, problems)?;
        check_count("goals", goals, problems)?;
        check_dim(dim)?;
        match &starts.states() {
            States::Paper(starts) => self.costs_from(starts, goals, actions.view()),
            States::Laid(starts) => self.costs_from(starts, goals, actions.view()),
        }
    }

    fn shared_rollout_costs(
        &self,
        start: &MazeFrames,
        goals: &MazeFrames,
        SharedCandidates { actions, .. }: SharedCandidates,
    ) -> Option<Result<Array2<f32>>> {
        Some(self.shared_costs(start, goals, actions.view()))
    }
}

impl MazeWorld {
    /// Planning costs `[B, D]` from `starts[B]` in any layout.
    fn costs_from<S: Ground>(
        &self,
        starts: &[State<S>],
        goals: &MazeFrames,
        actions: ArrayView4<'_, f32>,
    ) -> Result<Array2<f32>> {
        let (problems, candidates, steps, _) = actions.dim();
        let mut costs = Array2::zeros((problems, candidates));
        costs.axis_iter_mut(Axis(0)).into_par_iter().enumerate().try_for_each(|(b, mut row)| {
            let start = &starts[b];
            let space = start.scene.space();
            let (scene, terms) = self.terms(start, goals, b)?;
            let actions = actions.index_axis(Axis(0), b);
            row.axis_iter_mut(Axis(0))
                .into_par_iter()
                .enumerate()
                .with_min_len(CANDIDATES_PER_TASK)
                .for_each_init(Patch::default, |patch, (d, mut cost)| {
                    let actions = actions.index_axis(Axis(0), d);
                    if !are_finite(actions) {
                        cost.fill(f32::NAN);
                        return;
                    }
                    let mut tally = self.config.over_horizon.start();
                    roll(&space, start, actions, |step, state| {
                        if self.counts(step, steps) {
                            self.cost.patch(&self.renderer, &scene, state, patch);
                            let cost = self.cost.cost(&terms, patch);
                            tally = self.config.over_horizon.add(tally, cost);
                        }
                    });
                    cost.fill(tally);
                });
            Ok::<(), Error>(())
        })?;
        Ok(costs)
    }

    fn shared_costs(
        &self,
        start: &MazeFrames,
        goals: &MazeFrames,
        actions: ArrayView3<'_, f32>,
    ) -> Result<Array2<f32>> {
        check_count("start", start, 1)?;
        match &start.states() {
            States::Paper(states) => self.shared_costs_from(&states[0], goals, actions),
            States::Laid(states) => self.shared_costs_from(&states[0], goals, actions),
        }
    }

    fn shared_costs_from<S: Ground>(
        &self,
        start: &State<S>,
        goals: &MazeFrames,
        actions: ArrayView3<'_, f32>,
    ) -> Result<Array2<f32>> {
        let known: Vec<bool> = actions.outer_iter().map(are_finite).collect();
        let tame = actions.mapv(|a| if a.is_finite() { a } else { 0.0 });
        let states = self.rollout(start.clone(), tame.view())?;
        let (candidates, steps) = states.dim();
        let mut scene = vec![0; self.renderer.frame_len()];
        self.renderer.render_scene(&start.scene, &mut scene);
        let patches: Vec<Vec<Patch>> = states
            .axis_iter(Axis(0))
            .into_par_iter()
            .map(|row| {
                let counted = (0..steps).filter(|&step| self.counts(step, steps));
                let patch = |step: usize| {
                    let mut patch = Patch::default();
                    self.cost.patch(&self.renderer, &scene, &row[step], &mut patch);
                    patch
                };
                counted.map(patch).collect()
            })
            .collect();
        let mut costs = Array2::zeros((goals.len(), candidates));
        costs.axis_iter_mut(Axis(0)).into_par_iter().enumerate().try_for_each(|(b, mut row)| {
            let (_, terms) = self.terms(start, goals, b)?;
            for ((cost, patches), &known) in row.iter_mut().zip(&patches).zip(&known) {
                if !known {
                    *cost = f32::NAN;
                    continue;
                }
                let tally = self.config.over_horizon.start();
                *cost = patches.iter().fold(tally, |tally, patch| {
                    self.config.over_horizon.add(tally, self.cost.cost(&terms, patch))
                });
            }
            Ok::<(), Error>(())
        })?;
        Ok(costs)
    }
}

#[cfg(test)]
#[path = "world_tests.rs"]
mod tests;
