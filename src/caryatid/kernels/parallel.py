"""Compiled work shared out among the cores, so that each piece of it is compiled once only.

A loop of numba's own that runs in parallel compiles all that it calls anew, for many seconds where that is
much. Here one short loop calls the work by its address.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numba
import numpy as np
from numba import njit, prange, types
from numba.core import cgutils
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
    compiled = _compiled_for.get(layout)
    if compiled is None:
        compiled = _compiled_for[layout] = _Compiled.of(work, numba.typeof(data))
    compiled.loop(compiled.address, count, data, numba.get_num_threads())


class _Compiled(NamedTuple):
    """Work for one layout of data: its address, and the loop that calls it."""

    address: int
    loop: Callable[..., None]

    @classmethod
    def of(cls, work: Any, data: types.Type) -> _Compiled:
        one = (types.int64, data)
        _compile(work, one)
        result = work.overloads[one]
        signature = (types.int64, types.int64, data, types.int64)
        _compile(_loop, signature)
        address = result.library.get_pointer_to_function(result.fndesc.llvm_cfunc_wrapper_name)
        return cls(address, _loop.overloads[signature].entry_point)


def _compile(kernel: Any, arguments: tuple[Any, ...]) -> None:
    """Compile a kernel or take it from disk; what is kept there may name types that are no more."""
    try:
        kernel.compile(arguments)
    except (AttributeError, ImportError):
        kernel._cache.flush()
        kernel.compile(arguments)


_compiled_for: dict[tuple[Any, ...], _Compiled] = {}
"""By work and layout of data; `numba.typeof` takes a quarter of a millisecond."""


def _layout(value: object) -> object:
    """What a kernel is compiled for."""
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.ndim, value.flags.c_contiguous, value.flags.writeable
    return type(value)


@njit(cache=True, parallel=True)
def _loop(address, count, data, threads):  # type: ignore[no-untyped-def]
    """Threads take the next index when they are done with one: what takes long holds up no other work."""
    work = _at(address, data)
    if count == 1:
        work(0, data)
        return
    taken = np.zeros(1, dtype=np.int64)
    for _ in prange(min(count, threads)):
        index = _take(taken)
        while index < count:
            work(index, data)
            index = _take(taken)


@intrinsic
def _at(typing_context, address, data):  # type: ignore[no-untyped-def]
    """Return the work on such data by the address of its C entry; numba finds one by name anew each time."""
    kind = types.FunctionType(types.void(types.int64, data))

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        work = cgutils.create_struct_proxy(kind)(context, builder)
        work.c_addr = builder.inttoptr(arguments[0], work.c_addr.type)
        return work._getvalue()

    return kind(address, data), generate


@intrinsic
def _take(typing_context, taken):  # type: ignore[no-untyped-def]
    """Return the number in an array (1,) and raise it by one, as one step for all threads."""

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        numbers = context.make_array(signature.args[0])(context, builder, arguments[0])
        one = context.get_constant(types.int64, 1)
        return builder.atomic_rmw("add", numbers.data, one, "monotonic")

    return types.int64(taken), generate
