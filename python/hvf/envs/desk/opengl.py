"""An OpenGL context without a screen: OSMesa, or EGL.

OSMesa draws in software, the same on every machine, and is tried first; EGL draws on a graphics
card where there is one. ``MUJOCO_GL=osmesa`` or ``MUJOCO_GL=egl`` decides otherwise.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib
import os
from collections.abc import Iterator
from typing import Any

# Backend to the names under which its library is found, and the Debian packages that bring it.
_LIBRARIES = {
    "osmesa": (("libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so"), "libosmesa6"),
    "egl": (("libEGL.so.1", "libEGL.so"), "libegl1 libopengl0 libgl1-mesa-dri"),
}


def backend() -> str:
    """``"osmesa"`` or ``"egl"``: what ``MUJOCO_GL`` names, else the first that is installed.

    Raises:
        RuntimeError: neither, or not the one that is named; says which Debian package to install.
        ValueError: ``MUJOCO_GL`` names something else.
    """
    asked = os.environ.get("MUJOCO_GL", "").lower().strip()
    if asked and asked not in _LIBRARIES:
        raise ValueError(f"MUJOCO_GL: must be 'osmesa' or 'egl', got {asked!r}")
    for name in [asked] if asked else list(_LIBRARIES):
        if _installed(name):
            return name
    if asked:
        raise RuntimeError(
            f"rendering: MUJOCO_GL is {asked!r}, but its library is not installed; "
            f"on Debian: apt install {_LIBRARIES[asked][1]}"
        )
    raise RuntimeError(
        "rendering: no OpenGL library for drawing without a screen is installed; on Debian: "
        f"apt install {_LIBRARIES['osmesa'][1]} (or {_LIBRARIES['egl'][1]})"
    )


def check_environment() -> None:
    """Refuse a ``MUJOCO_GL`` that names a library which is not there.

    Raises:
        RuntimeError, ValueError: as :func:`backend`.
    """
    if os.environ.get("MUJOCO_GL", "").strip():
        backend()


def make_context(width: int, height: int) -> Any:
    """A current context that MuJoCo can draw with, for images up to this size.

    Raises:
        RuntimeError: no library (see :func:`backend`), or no context from it.
        ValueError: as :func:`backend`.
    """
    name = backend()
    try:
        with _symbols_kept_apart():
            context = importlib.import_module(f"mujoco.{name}").GLContext(width, height)
        context.make_current()
    except Exception as error:  # PyOpenGL raises what it likes, down to AttributeError
        raise RuntimeError(
            f"rendering: {name} gives no OpenGL context ({error}); on Debian: apt install "
            f"{_LIBRARIES[name][1]}. A process that has used another OpenGL platform "
            f"(PYOPENGL_PLATFORM={os.environ.get('PYOPENGL_PLATFORM')!r}) cannot change it"
        ) from error
    return context


@contextlib.contextmanager
def _symbols_kept_apart() -> Iterator[None]:
    """Libraries that PyOpenGL loads in here do not lend their symbols to others.

    PyOpenGL asks for the opposite. Mesa brings a whole LLVM; a library that is loaded later and
    brings another one, such as Triton's beside torch, would call into Mesa's and crash.
    """
    shared = ctypes.RTLD_GLOBAL
    ctypes.RTLD_GLOBAL = ctypes.RTLD_LOCAL  # type: ignore[misc]
    try:
        yield
    finally:
        ctypes.RTLD_GLOBAL = shared  # type: ignore[misc]


def _installed(name: str) -> bool:
    for library in _LIBRARIES[name][0]:
        try:
            ctypes.CDLL(library)
        except OSError:
            continue
        return True
    return False
