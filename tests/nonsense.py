"""Nonsense for the border between Python and Rust, made from choices.

Whatever makes the choices makes the nonsense: Hypothesis, which finds the least choices that break
something, or a generator of random numbers, which is a hundred times faster.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any, TypeAlias

import numpy as np

Choose: TypeAlias = Callable[[int], int]
"""Gives a whole number from 0 to below its argument; 0 is the least remarkable."""
Source: TypeAlias = Callable[[Choose], Any]
"""Makes a thing from choices."""

RAISED: list[BaseException] = []
"""What objects raised of their own accord, since this was last cleared."""


class OwnError(Exception):
    """What objects raise of their own accord: it has to come back as it is."""


def of(*things: Any) -> Source:
    """One of these."""
    return lambda choose: things[choose(len(things))]


def within(low: int, high: int) -> Source:
    """An integer from ``low`` to ``high``, most plainly the least that is not negative."""
    numbers = sorted(range(low, high + 1), key=lambda number: (number < 0, abs(number)))
    return of(*numbers)


def one_of(*sources: Source) -> Source:
    """What one of these makes."""
    return lambda choose: sources[choose(len(sources))](choose)


# --- objects --------------------------------------------------------------------------------


def raising(value: Any) -> Any:
    if isinstance(value, type) and issubclass(value, BaseException):
        error = value("raised by an argument")
        RAISED.append(error)
        raise error
    return value


class Length:
    """Says that it is as long as it was told to; has items for ever."""

    def __init__(self, length: Any) -> None:
        self.length = length

    def __len__(self) -> Any:
        return raising(self.length)

    def __getitem__(self, index: Any) -> Any:
        return self


class Index:
    """An integer, or so it says."""

    def __init__(self, value: Any) -> None:
        self.value = value

    def __index__(self) -> Any:
        return raising(self.value)

    def __float__(self) -> Any:
        return raising(self.value)


class Arraying:
    """An array, or so it says."""

    def __init__(self, value: Any) -> None:
        self.value = value

    def __array__(self, dtype: Any = None, copy: Any = None) -> Any:
        return raising(self.value)


class Entries(Mapping[Any, Any]):
    """A dictionary, or so it says, whose names or entries are what they were told to be."""

    def __init__(self, names: Any, entry: Any = None) -> None:
        self.names, self.entry = names, entry

    def __iter__(self) -> Iterator[Any]:
        return iter(raising(self.names))

    def __len__(self) -> int:
        return len(raising(self.names))

    def __getitem__(self, name: Any) -> Any:
        return raising(self.entry)


def misaligned(array: np.ndarray) -> np.ndarray:
    """The same numbers one byte off."""
    memory = np.zeros(array.nbytes + 1, np.uint8)
    moved = memory[1:].view(array.dtype).reshape(array.shape)
    moved[...] = array
    return moved


def packed(array: np.ndarray) -> np.ndarray:
    """The same numbers as a field of a packed structure."""
    table = np.zeros(array.shape, np.dtype([("a", "u1"), ("b", array.dtype)]))
    table["b"] = array
    return table["b"]


FAR = [
    sign * 2**k + d
    for k in (41, 62, 63, 64, 70, 127, 128, 300)
    for sign in (1, -1)
    for d in (-1, 0, 1)
]
"""Integers that are no size of anything, but would be one if bits were cut off."""
SMALL = within(-3, 9)
INTEGERS = one_of(SMALL, of(*FAR))
SETTINGS = one_of(SMALL, within(-3, 300), of(*FAR, 2**31, 2**32, 2**32 + 1))
FLOATS = of(
    *(0.0, -0.0, 1.0, -1.0, 0.5, 1e-60, 1e60, 3.5e38, 1e300),
    *(float("inf"), -float("inf"), float("nan")),
)
OTHERS = of(
    *(None, True, "", "uniform", "last", "\ud800", "1", b"1"),
    *((), [], [[1], [1, 2]], [None], {}, {1: 2}, {1, 2}),
    *(range(3), range(2**40), range(2**62), range(2**70)),
    *(1j, np.complex64(1), np.float64(2), np.int8(-3), np.uint64(2**64 - 1), np.bool_(True)),
    *(np.str_("a"), object(), object, len, ..., slice(None), slice(0, 2**70)),
    *(memoryview(b"abcd"), iter([1, 2]), np.datetime64(0, "s")),
)
LIES = one_of(INTEGERS, of("3", 1.5, None, OwnError, TypeError))
NAMES = of((), ("weight_hh",), (1, None), ("input", "output"), None, 3, OwnError, TypeError)
LIARS: Source = one_of(
    lambda choose: Length(LIES(choose)),
    lambda choose: Index(LIES(choose)),
    lambda choose: Arraying(of(np.zeros((1, 4)), [1], None, OwnError, TypeError, "x")(choose)),
    lambda choose: Entries(NAMES(choose), of(None, OwnError, KeyError, ())(choose)),
)
DTYPES = of(
    *("f4", "f8", "f2", ">f4", "u1", "i4", "i8", "u8", "?", "c8", "O", "U2", "S3"),
    *("M8[s]", "i4,f4"),
)
MOST_AXES = 40 if np.lib.NumpyVersion(np.__version__) >= "2.0.0" else 20


def quiet() -> Any:
    """Nothing is said of numbers that do not fit."""
    return np.errstate(all="ignore")


def array_like(choose: Choose, near: np.ndarray) -> Any:
    """An array much like ``near``."""
    array = near.copy()
    if array.size and array.dtype.kind == "f":
        with quiet():
            array.flat[choose(array.size)] = FLOATS(choose)
    return ordered(choose, array)


def arrays(choose: Choose) -> Any:
    """Arrays of every dtype, order and alignment."""
    shape = tuple(choose(6) for _ in range(choose(7)))
    array = np.zeros(shape, np.dtype(DTYPES(choose)))
    if array.dtype.kind in "fiub" and array.size:
        with quiet():
            array.flat[0] = of(0, 1, 3, 100)(choose)
    return ordered(choose, array)


def ordered(choose: Choose, array: np.ndarray) -> Any:
    """The same array, or some of it, in memory in one of many ways."""
    how = choose(13)
    if how == 1:
        array = np.asfortranarray(array)
    elif how == 2:
        array = array[::-1] if array.ndim else array
    elif how == 3 and not array.dtype.hasobject and array.dtype.fields is None:
        array = misaligned(array)
    elif how == 4 and not array.dtype.hasobject:
        array = packed(array)
    elif how == 5 and array.ndim:
        array = array[::2]
    elif how == 6 and array.size:
        # More along one axis than any memory has room for.
        axis = choose(max(array.ndim, 1))
        item = array.nbytes // max(array.shape[axis], 1) if array.ndim else 1
        shape = [*array.shape[:axis], 2**56 // item, *array.shape[axis + 1 :]]
        array = np.broadcast_to(array.take([0], axis) if array.ndim else array, shape)
    elif how == 7 and array.ndim < 8:
        array = array.reshape((1,) * MOST_AXES + array.shape)
    elif how == 8:
        array.flags.writeable = False
    elif how == 9:
        array = np.ma.masked_array(array)
    elif how == 10 and array.dtype == np.dtype("?"):
        array = np.full(array.shape, 7, np.uint8).view("?")
    elif how == 11:
        return array.tolist()
    elif how == 12 and array.dtype.kind == "f":
        return array.astype(np.float64)
    return array


ANYTHING = one_of(INTEGERS, FLOATS, OTHERS, LIARS, arrays)


def either(choose: Choose, sensible: Any, nonsense: Source = ANYTHING) -> Any:
    """What makes sense, mostly."""
    return sensible if choose(5) < 4 else instead(choose, sensible, nonsense)


def instead(choose: Choose, sensible: Any, nonsense: Source = ANYTHING) -> Any:
    """Nonsense in the place of what makes sense, or of a part of it."""
    if isinstance(sensible, np.ndarray) and not choose(2):
        return array_like(choose, sensible)
    if isinstance(sensible, (list, tuple)) and sensible and not choose(2):
        parts = list(sensible)
        place = choose(len(parts))
        if choose(4):
            parts[place] = instead(choose, parts[place], nonsense)
        else:
            parts = parts[:place] + parts[place + 1 :]
        return type(sensible)(parts)
    if isinstance(sensible, dict) and choose(4):
        name = list(sensible)[choose(len(sensible))]
        if choose(4):
            return {**sensible, name: instead(choose, sensible[name], nonsense)}
        rest = {other: entry for other, entry in sensible.items() if other != name}
        return rest if choose(2) else {**rest, of("any", 1, "scale", OwnError)(choose): None}
    return nonsense(choose)
