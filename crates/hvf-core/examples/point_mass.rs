//! Plans for a point that moves by its actions, and searches for stops on the way of a short plan.
//!
//! `cargo run --release -p hvf-core --example point_mass`

use hvf_core::ndarray::{s, Array2, Array3, Axis};
use hvf_core::{ActionSpace, Candidates, Frames, Result, SubgoalModel, WorldModel};
use hvf_core::{HvfConfig, MpcConfig};

/// Positions in the plane: what this world has instead of images.
#[derive(Clone, Debug)]
struct Points(Array2<f32>);

impl Frames for Points {
    fn len(&self) -> usize {
        self.0.nrows()
    }

    fn select(&self, index: &[usize]) -> Result<Self> {
        Ok(Self(self.0.select(Axis(0), index)))
    }
}

/// Every action, within `[-1, 1]` in both dimensions, moves the point by itself.
struct PointMass(ActionSpace);

impl WorldModel for PointMass {
    type Frames = Points;

    fn action_space(&self) -> &ActionSpace {
        &self.0
    }

    fn rollout_costs(
        &self,
        starts: &Points,
        goals: &Points,
        candidates: Candidates,
    ) -> Result<Array2<f32>> {
        let moves = candidates.actions.sum_axis(Axis(2));
        let missing =
            moves + starts.0.view().insert_axis(Axis(1)) - goals.0.view().insert_axis(Axis(1));
        Ok(missing.mapv(|x| x * x).sum_axis(Axis(2)))
    }
}

/// A latent is where it says, in units of five.
struct Anywhere;

impl SubgoalModel<Points> for Anywhere {
    fn latent_dim(&self) -> usize {
        2
    }

    fn decode(&self, _scene: &Points, latents: Array3<f32>) -> Result<Points> {
        let (samples, subgoals, dim) = latents.dim();
        let points = (latents * 5.0).into_shape_with_order((samples * subgoals, dim));
        Ok(Points(points.expect("as many numbers as before")))
    }
}

fn main() -> Result<()> {
    let world = PointMass(ActionSpace::new(vec![-1.0; 2], vec![1.0; 2])?);
    let start = Points(Array2::zeros((1, 2)));
    let goal = Points(Array2::from_elem((1, 2), 12.0));

    let plan = MpcConfig::default().plan(&world, &start, &goal, 0)?;
    println!("five steps leave a squared distance of {}", plan.cost);

    let found = HvfConfig::default().search(&world, &Anywhere, &start, &goal, 0)?;
    for stop in found.subgoals.0.outer_iter() {
        println!("stop at {:.1}, {:.1}", stop[0], stop[1]);
    }
    println!("then the hardest of three plans leaves {}", found.cost);
    println!("the first of which begins with {}", found.plans[0].actions.slice(s![0, ..]));
    Ok(())
}
