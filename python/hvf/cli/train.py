"""``hvf train``: models from collected data."""

from __future__ import annotations

from typing import Annotated

import tyro

from hvf.training.desk_dynamics import (
    DeskDynamicsTraining,
    LargeDeskDynamicsTraining,
    train_desk_dynamics,
)
from hvf.training.desk_generator import DeskGeneratorTraining, train_desk_generator
from hvf.training.dynamics import DynamicsTraining, train_dynamics
from hvf.training.keypoint_generator import GeneratorTraining, train_keypoint_generator
from hvf.training.subgoals import DeskSubgoalTraining, SubgoalTraining, train_subgoals
from hvf.training.temporal_distance import TemporalDistanceTraining, train_temporal_distance


def dynamics(config: Annotated[DynamicsTraining, tyro.conf.arg(name="")]) -> None:
    """Train the compact dynamics model of the maze.

    Ctrl-C stops; the same command goes on from there.
    """
    train_dynamics(config)


def desk_dynamics(config: Annotated[DeskDynamicsTraining, tyro.conf.arg(name="")]) -> None:
    """Train the compact dynamics model of the Franka desk.

    Ctrl-C stops; the same command goes on from there.
    """
    train_desk_dynamics(config)


def desk_dynamics_large(
    config: Annotated[LargeDeskDynamicsTraining, tyro.conf.arg(name="")],
) -> None:
    """Train the compact dynamics model of the Franka desk at a size for a GPU.

    Ctrl-C stops; the same command goes on from there.
    """
    train_desk_dynamics(config)


def desk_generator(config: Annotated[DeskGeneratorTraining, tyro.conf.arg(name="")]) -> None:
    """Train the generator of subgoals that draws states of the Franka desk.

    Needs a trained dynamics model. Ctrl-C stops; the same command goes on from there.
    """
    train_desk_generator(config)


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
