"""The desk in front of the Panda, composed with ``mujoco.MjSpec``.

Axes: x away from the robot, y to its left, z up; the table top is z = 0. Metres, kilograms.

Who touches whom, as MuJoCo's bits (a pair collides where the ``contype`` of one meets the
``conaffinity`` of the other): everything solid has ``contype`` 1; cubes have ``conaffinity`` 1, so
they rest on and bump into all of that; the arm's hand and finger have ``conaffinity`` 5; buttons
have ``contype`` 4, so that only the arm presses them and a cube may lie on one.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from hvf.envs.desk import panda

BASE = np.array([0.0, 0.0, -0.10])
"""Of the robot; the floor is as high."""
TABLE_X, TABLE_Y = (0.36, 0.80), 0.42
"""The table reaches from and to in x, and to either side in y."""

DOOR_TRAVEL = 0.40
"""From closed (0) to open."""
HANDLE_X, HANDLE_Z, HANDLE_RADIUS = 0.545, (0.08, 0.23), 0.011
HANDLE_CLOSED_Y = -0.20
"""The handle's y with the door closed; it is ``HANDLE_CLOSED_Y`` plus the door's opening."""
HUTCH_X = 0.665
"""The front of hutch, door and closed drawer."""

DRAWER_TRAVEL = 0.10
"""From closed (0) to open; a longer one catches blocks."""
DRAWER_Y, DRAWER_HEIGHT = (0.06, 0.34), 0.045
DRAWER_HANDLE_GAP = 0.056
"""Between the drawer's front and its bar: the finger is 0.040 thick."""

BUTTONS = ("left_button", "middle_button", "right_button")
BUTTON_PLACES = ((0.41, -0.14), (0.41, -0.23), (0.41, -0.32))
BUTTON_TRAVEL, BUTTON_LIT = 0.012, 0.005
"""How far a button goes down, and from where on it is lit."""

BLOCKS = ("red", "green", "blue")
BLOCK_SIZE, BLOCK_MASS = 0.07, 0.08
"""Side and mass of a cube."""

TIME_STEP = 0.005

CAMERA_OPENING = 45.0
"""Vertical opening angle of the camera, degrees."""

_WOOD, _DARK_WOOD, _INSIDE = (0.86, 0.76, 0.62, 1), (0.45, 0.30, 0.20, 1), (0.16, 0.12, 0.12, 1)
_FLOOR, _DOOR, _METAL = (0.40, 0.43, 0.47, 1), (0.93, 0.60, 0.12, 1), (0.10, 0.10, 0.12, 1)
_DRAWER, _DRAWER_TOP = (0.50, 0.32, 0.62, 1), (0.66, 0.50, 0.76, 1)
_BLOCK_COLOURS = ((0.85, 0.10, 0.10, 1), (0.10, 0.62, 0.18, 1), (0.10, 0.25, 0.85, 1))
BUTTON_DARK, BUTTON_BRIGHT = (0.30, 0.30, 0.33, 1), (1.0, 0.95, 0.35, 1)

_BOX, _SPHERE = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_SPHERE
_CAPSULE, _PLANE = mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_PLANE


def scene_spec() -> mujoco.MjSpec:
    """The scene, for changes before it is compiled."""
    spec = mujoco.MjSpec()
    spec.modelname = "franka_desk"
    spec.compiler.degree = False
    spec.option.timestep = TIME_STEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    # A state that is not finite must be seen, not silently replaced by the initial one.
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    _light(spec)
    panda.add_to(spec, BASE)
    _furniture(spec)
    _door(spec)
    _drawer(spec)
    _buttons(spec)
    _blocks(spec)
    return spec


def load_scene(path: str | Path | None = None) -> mujoco.MjModel:
    """Compile the scene, or one from an MJCF file that has its joints and actuators.

    Args:
        path: MJCF file to use instead, for other colours, masses or frictions; None for ours.

    Raises:
        FileNotFoundError: no file at ``path``.
        ValueError: a file that MuJoCo cannot read, or without the joints of our scene.
    """
    if path is None:
        return scene_spec().compile()
    if not Path(path).is_file():
        raise FileNotFoundError(f"{path}: no such scene file")
    try:
        model = mujoco.MjSpec.from_file(str(path)).compile()
    except (ValueError, mujoco.FatalError) as error:
        reason = " ".join(str(error).split())
        raise ValueError(f"{path}: not a scene that MuJoCo can read ({reason})") from error
    ours = scene_spec().compile()
    for kind, count in (("joint", "njnt"), ("actuator", "nu")):
        expected = [getattr(ours, kind)(i).name for i in range(getattr(ours, count))]
        found = [getattr(model, kind)(i).name for i in range(getattr(model, count))]
        if found != expected:
            raise ValueError(f"{path}: has the {kind}s {found}, expected {expected}")
    geoms = {model.geom(i).name for i in range(model.ngeom)}
    for name in (*BUTTONS, *(f"{button}_plate" for button in BUTTONS)):
        if name not in geoms:
            raise ValueError(f"{path}: has no geom {name!r}, which is lit when it is pressed")
    return model


def _light(spec: mujoco.MjSpec) -> None:
    # Only what software OpenGL draws fast: no shadow, no reflection, no multisampling.
    spec.visual.quality.offsamples = 0
    spec.visual.quality.shadowsize = 0
    # Round things as prisms of 12 sides: four times as fast, and no different at 64 pixels.
    spec.visual.quality.numslices = 12
    spec.visual.quality.numstacks = 6
    spec.visual.quality.numquads = 1
    spec.visual.headlight.ambient = [0.42] * 3
    spec.visual.headlight.diffuse = [0.38] * 3
    spec.visual.headlight.specular = [0.0] * 3
    spec.visual.map.znear = 0.05
    spec.visual.global_.fovy = CAMERA_OPENING
    spec.worldbody.add_light(
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        pos=[0.2, -0.6, 2.0],
        dir=[0.35, 0.45, -0.85],
        diffuse=[0.42] * 3,
        specular=[0.0] * 3,
        castshadow=False,
    )


def _box(body: mujoco.MjsBody, low: Any, high: Any, colour: Any, **options: Any) -> None:
    """A box between two corners."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    options = {"contype": 1, "conaffinity": 0, **options}
    body.add_geom(type=_BOX, size=(high - low) / 2, pos=(high + low) / 2, rgba=colour, **options)


def _furniture(spec: mujoco.MjSpec) -> None:
    world = spec.worldbody
    floor = BASE[2]
    world.add_geom(
        name="floor",
        type=_PLANE,
        size=[2, 2, 0.1],
        pos=[0, 0, floor],
        rgba=_FLOOR,
        contype=1,
        conaffinity=0,
    )
    front, back = TABLE_X
    _box(world, (front, -TABLE_Y, floor), (back, TABLE_Y, 0), _WOOD, name="table")
    # The hutch: back, sides and a plinth to both sides of the drawer. No roof, so that the camera
    # sees into it past the door.
    _box(world, (back - 0.02, -TABLE_Y, 0), (back, TABLE_Y, 0.24), _DARK_WOOD)
    for side in (-1, 1):
        low, high = sorted((side * TABLE_Y, side * (TABLE_Y - 0.015)))
        _box(world, (HUTCH_X, low, 0), (back - 0.02, high, 0.24), _DARK_WOOD)
    inside = TABLE_Y - 0.015
    for y in ((-inside, DRAWER_Y[0] - 0.004), (DRAWER_Y[1] + 0.004, inside)):
        _box(world, (HUTCH_X, y[0], 0), (back - 0.02, y[1], 0.050), _INSIDE)
    # Over the drawer there is only a thin shelf.
    _box(world, (HUTCH_X, -inside, 0.050), (back - 0.02, inside, 0.054), _INSIDE)


def _door(spec: mujoco.MjSpec) -> None:
    # Half as wide as the hutch: whether it is open or closed, the dark inside of the other half is
    # seen, which tells the two apart.
    door = spec.worldbody.add_body(name="door", pos=[HUTCH_X, HANDLE_CLOSED_Y, 0])
    door.add_joint(
        name="door",
        type=mujoco.mjtJoint.mjJNT_SLIDE,
        axis=[0, 1, 0],
        range=[0, DOOR_TRAVEL],
        limited=True,
        damping=[15.0, 0, 0],
        frictionloss=1.5,
    )
    door_mass = {"mass": 0.5, "friction": [0.6, 0.005, 0.0001]}
    _box(door, (0.0, -0.20, 0.056), (0.028, 0.20, 0.25), _DOOR, **door_mass)
    x = HANDLE_X - HUTCH_X
    low, high = HANDLE_Z[0] + HANDLE_RADIUS, HANDLE_Z[1] - HANDLE_RADIUS
    bars = (
        ([x, 0, low], [x, 0, high], HANDLE_RADIUS),
        ([x, 0, high], [0, 0, high], 0.008),
        ([x, 0, low + 0.03], [0, 0, low + 0.03], 0.008),
    )
    for begin, end, radius in bars:
        door.add_geom(
            type=_CAPSULE,
            fromto=[*begin, *end],
            size=[radius, 0, 0],
            rgba=_METAL,
            mass=0.05,
            contype=1,
            conaffinity=0,
        )


def _drawer(spec: mujoco.MjSpec) -> None:
    drawer = spec.worldbody.add_body(name="drawer", pos=[HUTCH_X, 0, 0])
    drawer.add_joint(
        name="drawer",
        type=mujoco.mjtJoint.mjJNT_SLIDE,
        axis=[-1, 0, 0],
        range=[0, DRAWER_TRAVEL],
        limited=True,
        damping=[15.0, 0, 0],
        frictionloss=1.5,
    )
    y0, y1 = DRAWER_Y
    bottom, top = 0.003, DRAWER_HEIGHT
    # A solid box with a lighter top: from above it looks like a drawer and costs one contact.
    _box(drawer, (0, y0, bottom), (0.11, y1, top - 0.001), _DRAWER, mass=0.4)
    _box(
        drawer,
        (0.010, y0 + 0.010, bottom),
        (0.11, y1 - 0.010, top),
        _DRAWER_TOP,
        mass=0,
        contype=0,
    )
    bar, centre = -DRAWER_HANDLE_GAP - 0.005, (y0 + y1) / 2
    _box(
        drawer,
        (bar - 0.005, centre - 0.07, 0.018),
        (bar + 0.005, centre + 0.07, top),
        _METAL,
        mass=0.05,
    )
    for side in (-1, 1):
        end = centre + side * 0.066
        _box(drawer, (bar, end - 0.004, 0.018), (0, end + 0.004, top - 0.005), _METAL, mass=0.02)


def _buttons(spec: mujoco.MjSpec) -> None:
    for name, (x, y) in zip(BUTTONS, BUTTON_PLACES, strict=True):
        button = spec.worldbody.add_body(name=name, pos=[x, y, 0], gravcomp=1)
        button.add_joint(
            name=name,
            type=mujoco.mjtJoint.mjJNT_SLIDE,
            axis=[0, 0, -1],
            range=[0, BUTTON_TRAVEL],
            limited=True,
            stiffness=[120.0, 0, 0],
            damping=[3.0, 0, 0],
        )
        # The plate around it is lit with the button; under the finger little else is seen.
        spec.worldbody.add_geom(
            name=f"{name}_plate",
            type=mujoco.mjtGeom.mjGEOM_CYLINDER,
            size=[0.046, 0.002, 0],
            pos=[x, y, 0.002],
            rgba=BUTTON_DARK,
            contype=0,
            conaffinity=0,
        )
        # A low dome: a finger that comes from the side pushes it down instead of being stopped.
        button.add_geom(
            name=name,
            type=_SPHERE,
            size=[0.032, 0, 0],
            pos=[0, 0, 0.004],
            rgba=BUTTON_DARK,
            mass=0.02,
            friction=[0.1, 0.005, 0.0001],
            priority=1,
            contype=4,
            conaffinity=0,
        )


def _blocks(spec: mujoco.MjSpec) -> None:
    for i, (name, colour) in enumerate(zip(BLOCKS, _BLOCK_COLOURS, strict=True)):
        block = spec.worldbody.add_body(name=name, pos=[0.46, 0.2 * (i - 1), BLOCK_SIZE / 2])
        block.add_freejoint(name=name)
        block.add_geom(
            name=name,
            type=_BOX,
            size=[BLOCK_SIZE / 2] * 3,
            rgba=colour,
            mass=BLOCK_MASS,
            friction=[0.5, 0.005, 0.0001],
            contype=1,
            conaffinity=1,
        )
