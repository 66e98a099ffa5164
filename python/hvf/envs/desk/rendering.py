"""Images of the desk from its states, in software, without a screen."""

from __future__ import annotations

import copy
import weakref
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from hvf.envs.desk.opengl import make_context
from hvf.envs.desk.scene import (
    BUTTON_BRIGHT,
    BUTTON_DARK,
    BUTTON_LIT,
    BUTTONS,
    CAMERA_OPENING,
)
from hvf.envs.desk.simulator import BUTTONS as BUTTON_POSITIONS
from hvf.envs.desk.simulator import POSITIONS, Floats, checked_states

Images = NDArray[np.uint8]

SUPERSAMPLING = 2
"""An image is drawn this many times as large, and averaged."""
MAX_IMAGE_SIZE = 1024


class DeskRenderer:
    """Draws states of the desk. Belongs to the thread that made it.

    Args:
        model: the scene; a copy is kept.
        image_size: width and height ``S`` of images, pixels, 8 to 1024.

    Raises:
        ValueError: an image size out of range.
        RuntimeError: no OpenGL; names the Debian package to install.
    """

    def __init__(self, model: mujoco.MjModel, image_size: int = 64) -> None:
        check_image_size(image_size)
        self.image_size = image_size
        size = image_size * SUPERSAMPLING
        # Buttons change their colour with the state, so the model is this renderer's own.
        self._model = copy.copy(model)
        self._model.vis.global_.offwidth = size
        self._model.vis.global_.offheight = size
        self._context = make_context(size, size)
        self._data = mujoco.MjData(self._model)
        self._scene = mujoco.MjvScene(self._model, maxgeom=200)
        self._scene.flags[:] = 0
        self._scene.flags[mujoco.mjtRndFlag.mjRND_CULL_FACE] = 1
        self._options = mujoco.MjvOption()
        self._perturbation = mujoco.MjvPerturb()
        self._camera = camera()
        self._drawing = mujoco.MjrContext(self._model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._drawing)
        self._area = mujoco.MjrRect(0, 0, size, size)
        self._pixels = np.empty((size, size, 3), np.uint8)
        # Also at the interpreter's end, when OpenGL's Python side is still there.
        self._free = weakref.finalize(self, _free, self._context, self._drawing)
        self._buttons = [
            [self._model.geom(geom).id for geom in (name, f"{name}_plate")] for name in BUTTONS
        ]

    def render(self, states: Floats) -> Images:
        """Images of ``states[B, 63]``: uint8 ``[B, S, S, 3]``.

        Raises:
            ValueError: another shape, or numbers that are not finite.
            RuntimeError: the renderer is closed.
        """
        states = checked_states(states)
        if not self._free.alive:
            raise RuntimeError("this renderer is closed")
        self._context.make_current()
        images = np.empty((len(states), self.image_size, self.image_size, 3), np.uint8)
        for image, state in zip(images, states, strict=True):
            self._draw(state)
            image[...] = _averaged(self._pixels[::-1])
        return images

    def close(self) -> None:
        """Give back what OpenGL holds; drawing after that is an error."""
        self._free()

    def _draw(self, state: Floats) -> None:
        self._data.qpos[:] = state[:POSITIONS]
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        for geoms, depth in zip(self._buttons, state[BUTTON_POSITIONS], strict=True):
            self._model.geom_rgba[geoms] = BUTTON_BRIGHT if depth > BUTTON_LIT else BUTTON_DARK
        mujoco.mjv_updateScene(
            self._model,
            self._data,
            self._options,
            self._perturbation,
            self._camera,
            mujoco.mjtCatBit.mjCAT_ALL,
            self._scene,
        )
        mujoco.mjr_render(self._area, self._scene, self._drawing)
        mujoco.mjr_readPixels(self._pixels, None, self._area, self._drawing)


def _free(context: Any, drawing: mujoco.MjrContext) -> None:
    context.make_current()
    drawing.free()
    context.free()


def camera() -> mujoco.MjvCamera:
    """The camera of the data and of the tasks; its opening angle is the model's."""
    view = mujoco.MjvCamera()
    view.type = mujoco.mjtCamera.mjCAMERA_FREE
    view.azimuth, view.elevation, view.distance = 75.0, -58.0, 1.12
    view.lookat[:] = (0.49, 0.0, 0.03)
    return view


def project(points: Floats, image_size: int) -> Floats:
    """Where ``points[N, 3]`` (m) are in an image: column and row, pixels, ``[N, 2]``.

    The middle of the upper left pixel is (0, 0).
    """
    view = camera()
    turn, tilt = np.deg2rad([view.azimuth, view.elevation])
    forward = np.array([np.cos(tilt) * np.cos(turn), np.cos(tilt) * np.sin(turn), np.sin(tilt)])
    right = np.array([np.sin(turn), -np.cos(turn), 0.0])
    away = points - (view.lookat - view.distance * forward)
    focal = image_size / 2 / np.tan(np.deg2rad(CAMERA_OPENING) / 2)
    plane = np.stack([away @ right, -away @ np.cross(right, forward)], axis=1)
    projected: Floats = focal * plane / (away @ forward)[:, None] + (image_size - 1) / 2
    return projected


def check_image_size(image_size: int) -> None:
    """Refuse an image size that cannot be drawn.

    Raises:
        TypeError: no integer.
        ValueError: below 8 or above 1024.
    """
    if isinstance(image_size, bool) or not isinstance(image_size, (int, np.integer)):
        raise TypeError(f"image_size: expected an integer, got {image_size!r}")
    if not 8 <= image_size <= MAX_IMAGE_SIZE:
        raise ValueError(f"image_size: must be from 8 to {MAX_IMAGE_SIZE}, got {image_size}")


def _averaged(pixels: Images) -> Images:
    """Means of squares of ``SUPERSAMPLING`` pixels, rounded to the nearest."""
    k = SUPERSAMPLING
    total = np.zeros((len(pixels) // k, len(pixels) // k, 3), np.uint16)
    for i in range(k):
        for j in range(k):
            total += pixels[i::k, j::k]
    averaged: Images = ((total + k * k // 2) // (k * k)).astype(np.uint8)
    return averaged
