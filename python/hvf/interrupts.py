"""Ctrl-C and SIGTERM for long work: noted when they come, obeyed where they do no harm."""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
from collections.abc import Iterator
from types import FrameType
from typing import Any


class Interrupts:
    """Notes the first Ctrl-C or SIGTERM in ``asked``; the second one interrupts at once.

    An exception that a signal raises wherever the program happens to be is lost inside a weak
    reference's callback or a destructor; a note is not, and nobody is told of the loss.

    A signal that is ignored when the block begins stays ignored: whoever started the program, a
    script that put it into the background for one, wanted it so.

    Args:
        at_once: the first one interrupts, too; the note is for the case that this gets lost, so
            that :meth:`check` still finds it.

    Attributes:
        asked: whether somebody wants the work to stop.
    """

    def __init__(self, at_once: bool = False) -> None:
        self.asked = False
        self._at_once = at_once
        self._before: dict[int, Any] = {}
        self._told = sys.unraisablehook

    def __enter__(self) -> Interrupts:
        """Begin to listen, in the main thread; elsewhere no signal arrives."""
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                before = signal.getsignal(number)
                if before is not signal.SIG_IGN:
                    self._before[number] = before
                    signal.signal(number, self._note)
            self._told, sys.unraisablehook = sys.unraisablehook, self._lost
        return self

    def __exit__(self, *_: object) -> None:
        """Give the signals back to whoever had them."""
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._before = {}
        if sys.unraisablehook == self._lost:
            sys.unraisablehook = self._told

    def check(self) -> None:
        """Raise KeyboardInterrupt if somebody asked."""
        if self.asked:
            raise KeyboardInterrupt

    def _note(self, _number: int, _frame: FrameType | None) -> None:
        second, self.asked = self.asked, True
        if second or self._at_once:
            raise KeyboardInterrupt

    def _lost(self, lost: sys.UnraisableHookArgs, /) -> None:
        """Tell of an exception that nobody can catch, unless it is an interrupt that is noted."""
        if not (self.asked and issubclass(lost.exc_type, KeyboardInterrupt)):
            self._told(lost)


@contextlib.contextmanager
def sigterm_as_interrupt() -> Iterator[None]:
    """In this block SIGTERM raises KeyboardInterrupt in the main thread, as Ctrl-C does.

    What stops a job on a server or in a container (``kill``, ``timeout``, a scheduler) sends
    SIGTERM; Python's own answer is to die where it stands, without a ``finally``. Work inside
    :class:`Interrupts` notes the signal as usual. The handler from before comes back at the end.
    Does nothing outside the main thread, where no signal arrives, and where SIGTERM is ignored.
    """
    before = signal.getsignal(signal.SIGTERM)
    if threading.current_thread() is not threading.main_thread() or before is signal.SIG_IGN:
        yield
        return
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
