"""Compiled work shared out among the cores, so that each piece of it is compiled once only.

A loop of numba's own that runs in parallel compiles all that it calls anew, for many seconds where that is
much. Here one short loop calls the work by its address.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba
import numpy as np
from numba import njit, prange, types


def for_each(work: Any, count: int, data: tuple[Any, ...]) -> None:
    """Call compiled work for each index from 0 to count − 1, on as many threads as numba uses.

    What it does for one index must touch nothing that it reads or writes for another: then the result is the
    same on any number of threads.

    Args:
        work: Called as `work(index, data)`; it must not raise.
        count: How many indices there are.
        data: Arrays and numbers, best a `NamedTuple`; results are written to arrays among them.
    """
    layout = (work, *map(_layout, data))
    entries = _entries.get(layout)
    if entries is None:
        kind = numba.typeof(data)
        one = types.void(types.int64, kind)
        signature = (types.FunctionType(one), types.int64, kind)
        work.compile(one.args)
        _loop.compile(signature)
        entries = work.overloads[one.args].entry_point, _loop.overloads[signature].entry_point
        _entries[layout] = entries
    alone, loop = entries
    if count == 1:
        alone(0, data)
    else:
        loop(work, count, data)


_entries: dict[tuple[Any, ...], tuple[Callable[..., None], Callable[..., None]]] = {}
"""Work and loop as compiled for each layout of data; `numba.typeof` takes a quarter of a millisecond."""


def _layout(value: object) -> object:
    """What a kernel is compiled for."""
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.ndim, value.flags.c_contiguous, value.flags.writeable
    return type(value)


@njit(cache=True, parallel=True)
def _loop(work, count, data):  # type: ignore[no-untyped-def]
    for index in prange(count):
        work(np.int64(index), data)
