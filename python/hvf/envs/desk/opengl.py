"""An OpenGL context without a screen: OSMesa, or EGL.

OSMesa draws in software, the same on every machine, and is tried first; EGL draws on a graphics
card where there is one. ``MUJOCO_GL=osmesa`` or ``MUJOCO_GL=egl`` decides otherwise.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib
import importlib.util
import os
import sys
import threading
from collections.abc import Iterator
from types import ModuleType
from typing import Any

# Backend to the names under which its library is found, and the Debian packages that bring it.
_LIBRARIES = {
    "osmesa": (("libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so"), "libosmesa6"),
    "egl": (("libEGL.so.1", "libEGL.so"), "libegl1 libopengl0 libgl1-mesa-dri"),
}

_LOADER = "OpenGL.platform.ctypesloader"
_loading = threading.RLock()


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
        if name == "egl":
            _load_triton()
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
    brings another one, such as Triton's beside torch, would call into Mesa's and crash. Only
    PyOpenGL's own function that loads libraries is exchanged, and only in here: what anybody else
    loads meanwhile is loaded as they ask. One thread at a time.
    """
    with _loading:
        loader = _library_loader()
        load = loader.loadLibrary

        def load_apart(kind: Any, name: str, mode: int = 0) -> Any:
            return load(kind, name, ctypes.RTLD_LOCAL)

        loader.loadLibrary = load_apart  # type: ignore[attr-defined]
        try:
            yield
        finally:
            loader.loadLibrary = load  # type: ignore[attr-defined]


def _load_triton() -> None:
    """Load Triton's library, if there is one, before Mesa's driver.

    EGL loads the driver, and with it Mesa's LLVM, for all to see, and no caller can keep it from
    that. Triton's library, which torch's optimisers load, would use it in place of its own and
    crash; loaded first it has found its own.
    """
    package = importlib.util.find_spec("triton")
    for folder in (package and package.submodule_search_locations) or ():
        with contextlib.suppress(OSError):
            ctypes.CDLL(os.path.join(folder, "_C", "libtriton.so"))


def _library_loader() -> ModuleType:
    """PyOpenGL's module that loads libraries, alone.

    Its package loads them as soon as it is imported, which an import of the module in the usual
    way would bring about first.
    """
    if _LOADER in sys.modules:
        return sys.modules[_LOADER]
    package = importlib.util.find_spec("OpenGL")
    if package is None or not package.submodule_search_locations:
        raise ImportError("PyOpenGL is not installed")
    path = os.path.join(package.submodule_search_locations[0], "platform", "ctypesloader.py")
    spec = importlib.util.spec_from_file_location(_LOADER, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    sys.modules[_LOADER] = module
    return module


def _installed(name: str) -> bool:
    for library in _LIBRARIES[name][0]:
        try:
            ctypes.CDLL(library)
        except OSError:
            continue
        return True
    return False
