"""The Franka desk of Nair & Finn (2020), section 6.2: a door, a drawer and three cubes, in MuJoCo.

Two things differ from the paper. *2 Block* there pushes the left-end and the middle block; here two
random cubes have to leave the table, each over the side it is nearer to. And the learned subgoals
are chained: each is drawn given the one before, since the generator knows what a few seconds of
play change, while the paper draws every subgoal from all images of the scene.

Light to import: MuJoCo is loaded when the desk is opened.
"""

from __future__ import annotations

from hvf.domains.domain import Domain, Place
from hvf.domains.weights import WEIGHTS
from hvf.settings import Planning, Preset, World

_OBJECTS = World("layers")

# Elites compete again, and each search begins around the rest of the last plan; what counts is the
# nearest frame of a plan, since a pushed cube is seen best before the arm moves on. The paper does
# none of this. Pushing a cube takes a plan that few candidates come near, and counts for less than
# an arm a few pixels off unless what is behind the arm counts once more. The paper plans five
# actions of three steps each. Subgoals are searched by how likely play leads from one to the next:
# in pixels a cube that stays where it is costs less than an arm a few pixels off.
_DEFAULT = Planning(
    samples=1000,
    elites=40,
    keep_elites=10,
    warm_start=True,
    initial="normal",
    horizon=15,
    action_repeat=3,
    replan_every=3,
    over_horizon="min",
    scene_weight=3.0,
    subgoal_samples=2000,
    subgoal_elites=50,
    subgoal_iterations=8,
    segment_cost="likelihood",
    steps_per_subgoal=20,
)
_PAPER = Planning(
    initial="normal",
    horizon=15,
    action_repeat=3,
    steps_per_subgoal=20,
)
# For video models, whose generator draws images and cannot say how likely they are, so that each
# segment is planned, with a budget that a core can pay: some seconds a search.
_VIDEO = Planning(
    samples=200,
    elites=10,
    iterations=3,
    keep_elites=10,
    warm_start=True,
    initial="normal",
    horizon=15,
    action_repeat=3,
    replan_every=3,
    subgoal_samples=60,
    subgoal_elites=12,
    subgoal_iterations=3,
    steps_per_subgoal=20,
)
# What a core can pay for true dynamics: 256 candidates, each one action that is held for three
# steps and then acted to its end, since it does just what was predicted. So few find the thin arm
# of a goal image only through a blur.
_SIMULATOR = Planning(
    samples=64,
    elites=8,
    iterations=4,
    keep_elites=2,
    initial="normal",
    initial_std=0.75,
    horizon=3,
    action_repeat=3,
    replan_every=3,
    blur=3.0,
    subgoal_samples=20,
    subgoal_elites=5,
    subgoal_iterations=2,
    steps_per_subgoal=6,
    threshold=5e-4,
    reached_blur=2.0,
)


def _open(workers: int) -> Place:
    from hvf.domains.desk.place import Desk

    return Desk(workers)


DESK = Domain(
    name="desk",
    about="a Franka arm closes a door and pushes cubes off a table (paper, section 6.2)",
    open_with=_open,
    action_low=(-1.0,) * 3,
    action_high=(1.0,) * 3,
    # The paper's; `hvf.envs.desk.tasks.MAX_STEPS` is the same, and needs MuJoCo.
    tasks={"door": 50, "two_block": 50, "door_block": 100, "door_two_block": 100},
    presets={
        "default": Preset(_DEFAULT, _OBJECTS, "subgoals by likelihood, warm starts"),
        "paper": Preset(_PAPER, _OBJECTS, "planning as published; generator: the object model's"),
        "video": Preset(
            _VIDEO,
            World("latent"),
            "video models throughout: subgoals by planning, in images",
        ),
        "simulator": Preset(
            _SIMULATOR,
            World("simulator"),
            "what two cores can pay for true dynamics",
            method="none",
        ),
    },
    weights={
        "layers": WEIGHTS / "desk_dynamics.safetensors",
        "layers-generator": WEIGHTS / "desk_generator.safetensors",
        "layers-proposals": WEIGHTS / "desk_proposals.safetensors",
        "layers-distance": WEIGHTS / "desk_distance.safetensors",
        "latent": WEIGHTS / "desk_latent.safetensors",
        "cvae": WEIGHTS / "desk_cvae.safetensors",
    },
    generators={"layers": "layers-generator", "latent": "cvae"},
    video_generator="cvae",
    distances={"layers": "layers-distance"},
    privileged=("simulator",),
    collection="hvf.domains.desk.collection:DeskCollection",
    experiments="hvf.experiments.desk:desk",
    # "About 15%", "about 15%" and "over 42%" in the text; all else is a bar chart.
    published={
        ("none", 0): {"door_two_block": 0.15},
        ("hvf", 1): {"door_two_block": 0.15},
        ("hvf", 2): {"door_two_block": 0.42},
    },
    groups={
        "end effector": slice(0, 3),
        "door": slice(3, 4),
        "drawer": slice(4, 5),
        "red block": slice(8, 11),
        "green block": slice(11, 14),
        "blue block": slice(14, 17),
    },
    slow=True,
    demo={"task": "door_two_block", "subgoals": 2, "episodes": 4, "pictures": 4},
)
