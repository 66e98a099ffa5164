//! Episodes and random interaction in any layout, keyed as those of the paper's maze.

use std::sync::Arc;

use super::description::{Layout, Region};
use super::scene::{LayoutScene, LayoutState};
use super::way::Way;
use crate::maze::episodes::{Draws, Episode, Purpose};
use crate::maze::geometry::State;
use crate::maze::physics::ACTION_LIMIT;

/// Draws after which a region counts as full, in one scene of a layout of which others had room.
const MOST_DRAWS: usize = 10_000;

impl Layout {
    /// Episode `index` of `seed`: gaps, start and target.
    pub fn episode(self: &Arc<Self>, seed: u64, index: u64) -> Episode<Arc<LayoutScene>> {
        let mut draws = Draws::new(seed, index, Purpose::Task);
        let scene = Arc::new(self.scene_of(&mut draws));
        let position = free(&mut draws, &scene, self.start());
        let target = free(&mut draws, &scene, self.goal());
        Episode { start: State { scene, position }, target }
    }

    /// Random interaction: where episode `index` of `seed` starts (uniform over free space, with
    /// gaps of its own) and its `steps` actions (uniform over the box).
    pub fn random_interaction(
        self: &Arc<Self>,
        seed: u64,
        index: u64,
        steps: usize,
    ) -> (LayoutState, Vec<[f32; 2]>) {
        let mut draws = Draws::new(seed, index, Purpose::Interaction);
        let scene = Arc::new(self.scene_of(&mut draws));
        let [x, y] = scene.obstacles().reach();
        let position = free(&mut draws, &scene, Region { x: [-x, x], y: [-y, y] });
        let mut action = || draws.uniform(-ACTION_LIMIT, ACTION_LIMIT) as f32;
        let actions = (0..steps).map(|_| [action(), action()]).collect();
        (State { scene, position }, actions)
    }

    /// The scene of an episode.
    pub(super) fn drawn_scene(self: &Arc<Self>, seed: u64, index: u64) -> LayoutScene {
        self.scene_of(&mut Draws::new(seed, index, Purpose::Task))
    }

    fn scene_of(self: &Arc<Self>, draws: &mut Draws) -> LayoutScene {
        let gaps = self.gaps().map(|gap| draws.uniform(gap.range[0], gap.range[1])).collect();
        LayoutScene::new(Arc::clone(self), gaps)
    }
}

impl Episode<Arc<LayoutScene>> {
    /// `count` ground-truth subgoals: places on the shortest way to the target, at its turns or
    /// between them ([`Way::places`]), moved a little towards the middle of free space; on the
    /// straight line if there is no way.
    pub fn subgoals(&self, count: usize) -> Vec<LayoutState> {
        let scene = &self.start.scene;
        let space = scene.obstacles();
        let way = Way::shortest(scene, self.start.position, self.target)
            .unwrap_or_else(|| Way::straight(self.start.position, self.target));
        let places = way.places(count).into_iter();
        let state = |place| {
            let position = space.roomiest(space.push_out(place));
            State { scene: Arc::clone(scene), position }
        };
        places.map(state).collect()
    }
}

/// Uniform over the part of a region where the agent can stand.
fn free(draws: &mut Draws, scene: &LayoutScene, Region { x, y }: Region) -> [f64; 2] {
    let mut position = [0.0; 2];
    for _ in 0..MOST_DRAWS {
        position = [draws.uniform(x[0], x[1]), draws.uniform(y[0], y[1])];
        if scene.obstacles().penetration(position) <= 0.0 {
            return position;
        }
    }
    scene.obstacles().push_out(position)
}
