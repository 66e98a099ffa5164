"""``hvf train``: models from collected data."""

from __future__ import annotations

from typing import Annotated

import tyro

from hvf.training.recipes.keypoint import DynamicsTraining, train_dynamics
from hvf.training.recipes.keypoint_generator import GeneratorTraining, train_keypoint_generator
from hvf.training.recipes.layers import (
    LargeLayersTraining,
    LayersTraining,
    train_layers,
)
from hvf.training.recipes.layers_generator import LayersGeneratorTraining, train_layers_generator
from hvf.training.recipes.temporal_distance import TemporalDistanceTraining, train_temporal_distance
from hvf.training.recipes.vae import DeskSubgoalTraining, SubgoalTraining, train_subgoals


def dynamics(config: Annotated[DynamicsTraining, tyro.conf.arg(name="")]) -> None:
    """Train the compact dynamics model of the maze.

    Ctrl-C stops; the same command goes on from there.
    """
    train_dynamics(config)


def desk_dynamics(config: Annotated[LayersTraining, tyro.conf.arg(name="")]) -> None:
    """Train the compact dynamics model of the Franka desk.

    Ctrl-C stops; the same command goes on from there.
    """
    train_layers(config)


def desk_dynamics_large(
    config: Annotated[LargeLayersTraining, tyro.conf.arg(name="")],
) -> None:
    """Train the compact dynamics model of the Franka desk at a size for a GPU.

    Ctrl-C stops; the same command goes on from there.
    """
    train_layers(config)


def desk_generator(config: Annotated[LayersGeneratorTraining, tyro.conf.arg(name="")]) -> None:
    """Train the generator of subgoals that draws states of the Franka desk.

    Needs a trained dynamics model. Ctrl-C stops; the same command goes on from there.
    """
    train_layers_generator(config)


def subgoals(config: Annotated[SubgoalTraining, tyro.conf.arg(name="")]) -> None:
    """Train the conditional variational autoencoder that draws subgoal images of the maze.

    Ctrl-C stops; the same command goes on from there.
    """
    train_subgoals(config)


def desk_subgoals(config: Annotated[DeskSubgoalTraining, tyro.conf.arg(name="")]) -> None:
    """Train the variational autoencoder that draws subgoal images of the Franka desk.

    Ctrl-C stops; the same command goes on from there.
    """
    train_subgoals(config)


def keypoint_generator(config: Annotated[GeneratorTraining, tyro.conf.arg(name="")]) -> None:
    """Train the generator of subgoals that draws keypoints for the compact dynamics model.

    Needs a trained dynamics model. Ctrl-C stops; the same command goes on from there.
    """
    train_keypoint_generator(config)


def temporal_distance(config: Annotated[TemporalDistanceTraining, tyro.conf.arg(name="")]) -> None:
    """Train the classifier of the steps between two frames, a planning cost for the maze.

    Needs a trained dynamics model. Ctrl-C stops; the same command goes on from there.
    """
    train_temporal_distance(config)
