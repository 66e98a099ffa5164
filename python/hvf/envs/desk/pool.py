"""Desks in processes of their own, to render and to roll out on all cores.

MuJoCo's rollouts use threads well, but an OpenGL context belongs to one thread and drawing from
Python holds the interpreter; so each process has its own simulator and renderer.

Signals are for the process that asked for the work, which decides what to do: Ctrl-C and SIGTERM
reach the whole group of processes, and those of a pool let them pass. They end with their pool,
and within a second once the process that made it is gone, however it ended.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from pathlib import Path
from typing import Any, Concatenate, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

from hvf.closing import Closing
from hvf.cores import cores
from hvf.envs.desk.opengl import backend
from hvf.envs.desk.rendering import DeskRenderer, Images, check_image_size
from hvf.envs.desk.scene import load_scene
from hvf.envs.desk.simulator import DeskSimulator, DivergenceError, Floats, checked_states

P = ParamSpec("P")
T = TypeVar("T")

_CHUNK = 64
"""States that a process is given at a time, at most."""

_WATCH_SECONDS = 0.5
"""How often a process looks whether the one that asked for the work is still there."""


class Worker:
    """What a process of the pool has: ``simulator``, ``renderer``, and the word to stop."""

    def __init__(self, image_size: int, scene: str | Path | None, stop: Any) -> None:
        self.simulator = DeskSimulator(scene)
        self.renderer = DeskRenderer(self.simulator.model, image_size)
        self._stop = stop

    def check(self) -> None:
        """Long work calls this now and then.

        Raises:
            InterruptedError: the pool is being closed.
        """
        if self._stop.is_set():
            raise InterruptedError("the pool is being closed")


class DeskPool(Closing):
    """Processes with a simulator and a renderer each. Close it, or use it in a ``with`` block.

    Args:
        workers: number of processes; 0 for as many as there are cores.
        image_size: width and height ``S`` of images, pixels.
        scene: MJCF file to use in place of the package's own scene.

    Raises:
        ValueError, TypeError, FileNotFoundError: a setting out of range, or a bad scene file.
        RuntimeError: no OpenGL; names the Debian package to install.
    """

    def __init__(
        self, workers: int = 0, image_size: int = 64, scene: str | Path | None = None
    ) -> None:
        if workers < 0:
            raise ValueError(f"workers: must not be negative, got {workers}")
        # What would fail in every process fails here, once.
        check_image_size(image_size)
        backend()
        load_scene(scene)
        self.workers = workers or cores()
        self.image_size = image_size
        context = multiprocessing.get_context("spawn")
        self._stop = context.Event()
        self._executor = ProcessPoolExecutor(
            self.workers, context, _begin, (image_size, scene, self._stop)
        )

    def close(self) -> None:
        """Stop the processes, also in the middle of their work."""
        self._stop.set()
        self._executor.shutdown(wait=True, cancel_futures=True)

    def submit(
        self, function: Callable[Concatenate[Worker, P], T], *args: P.args, **kwargs: P.kwargs
    ) -> Future[T]:
        """Run ``function(worker, ...)`` in a process; it must be found by its module's name."""
        with _signals_blocked():  # this may start a process, which inherits the mask
            return self._executor.submit(_run, function, *args, **kwargs)  # type: ignore[arg-type]

    def render(self, states: Floats) -> Images:
        """Images of ``states[B, 63]``: uint8 ``[B, S, S, 3]``.

        Raises:
            ValueError: another shape, or numbers that are not finite.
        """
        states = checked_states(states)
        parts = [self.submit(_render, states[part]) for part in self.parts(len(states))]
        size = self.image_size
        return np.concatenate([np.empty((0, size, size, 3), np.uint8), *_results(parts)])

    def rollout(self, states: Floats, actions: NDArray[np.floating]) -> tuple[Floats, Images]:
        """Last states ``[B, 63]``, and their images, after ``actions[B, H, 3]``.

        Raises:
            DivergenceError: a simulation diverged.
            ValueError: other shapes, or numbers that are not finite.
        """
        states = checked_states(states)
        if len(actions) != len(states):
            raise ValueError(f"actions: expected {len(states)} sequences, got {len(actions)}")
        chunks = self.parts(len(states))
        parts = [self.submit(_rollout, states[part], actions[part]) for part in chunks]
        ends, images = [], []
        for chunk, part in zip(chunks, parts, strict=True):
            try:
                end, image = part.result()
            except DivergenceError as error:
                which = [chunk.start + number for number in error.which]
                raise DivergenceError(which, error.step) from error
            ends.append(end)
            images.append(image)
        size = self.image_size
        return (
            np.concatenate([np.empty((0, states.shape[1])), *ends]),
            np.concatenate([np.empty((0, size, size, 3), np.uint8), *images]),
        )

    def parts(self, count: int) -> list[slice]:
        """Slices of ``count`` things, one for each call of :meth:`submit`."""
        chunk = max(1, min(_CHUNK, -(-count // self.workers)))
        return [slice(first, min(first + chunk, count)) for first in range(0, count, chunk)]


_worker: Worker | None = None


def _begin(image_size: int, scene: str | Path | None, stop: Any) -> None:
    global _worker
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    maker = multiprocessing.parent_process()
    assert maker is not None
    threading.Thread(target=_watch, args=(maker.pid,), name="watch", daemon=True).start()
    # Mesa would draw with threads of its own in each process.
    os.environ.setdefault("LP_NUM_THREADS", "0")
    _worker = Worker(image_size, scene, stop)


@contextlib.contextmanager
def _signals_blocked() -> Iterator[None]:
    """SIGINT and SIGTERM wait until this thread leaves the block.

    A process started in here inherits that, and so never sees them: neither while it imports its
    modules, where they would end it with a traceback, nor later.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGTERM))
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _watch(maker: int) -> None:
    """End this process once the one that made it is gone, or tells it to."""
    while os.getppid() == maker:
        if hasattr(signal, "sigtimedwait"):
            # An executor that is broken ends its processes by SIGTERM. Everybody else's passes.
            told = signal.sigtimedwait((signal.SIGTERM,), _WATCH_SECONDS)
            if told is not None and told.si_pid == maker:
                break
        else:
            time.sleep(_WATCH_SECONDS)
    # Without a word: nobody is there to hear it, and locks of the pool may be held for ever.
    os._exit(1)


def _run(function: Callable[..., T], *args: Any, **kwargs: Any) -> T:
    assert _worker is not None
    return function(_worker, *args, **kwargs)


def _render(worker: Worker, states: Floats) -> Images:
    return worker.renderer.render(states)


def _rollout(
    worker: Worker, states: Floats, actions: NDArray[np.floating]
) -> tuple[Floats, Images]:
    ends = worker.simulator.rollout(states, actions)[:, -1] if actions.shape[1] else states
    return ends, worker.renderer.render(ends)


def _results(parts: Sequence[Future[T]]) -> list[T]:
    return [part.result() for part in parts]
