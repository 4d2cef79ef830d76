"""Compiled work shared out among the cores, so that each piece of it is compiled once only.

A loop of numba's own that runs in parallel compiles all that it calls anew, for many seconds where that is
much. Here one short loop calls the work by its address.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba
import numpy as np
from numba import get_num_threads, njit, prange, types
from numba.extending import intrinsic


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
        _compile(work, one.args)
        _compile(_loop, signature)
        entry = _entries[layout] = _loop.overloads[signature].entry_point
    entry(work, count, data)


def _compile(kernel: Any, arguments: tuple[Any, ...]) -> None:
    """Compile a kernel or take it from disk; what is kept there may name types that are no more."""
    try:
        kernel.compile(arguments)
    except (AttributeError, ImportError):
        kernel._cache.flush()
        kernel.compile(arguments)


_entries: dict[tuple[Any, ...], Callable[[Any, int, tuple[Any, ...]], None]] = {}
"""The loop as compiled for each work and layout of data; `numba.typeof` takes a quarter of a millisecond."""


def _layout(value: object) -> object:
    """What a kernel is compiled for."""
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.ndim, value.flags.c_contiguous, value.flags.writeable
    return type(value)


@njit(cache=True, parallel=True)
def _loop(work, count, data):  # type: ignore[no-untyped-def]
    """Threads take the next index when they are done with one: what takes long holds up no other work."""
    if count == 1:
        work(0, data)
        return
    taken = np.zeros(1, dtype=np.int64)
    for _ in prange(min(count, get_num_threads())):
        index = _take(taken)
        while index < count:
            work(index, data)
            index = _take(taken)


@intrinsic
def _take(typing_context, taken):  # type: ignore[no-untyped-def]
    """Return the number in an array (1,) and raise it by one, as one step for all threads."""

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        numbers = context.make_array(signature.args[0])(context, builder, arguments[0])
        one = context.get_constant(types.int64, 1)
        return builder.atomic_rmw("add", numbers.data, one, "monotonic")

    return types.int64(taken), generate
