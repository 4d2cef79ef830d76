"""Compiled work shared out among the cores, so that each piece of it is compiled once only.

A loop of numba's own that runs in parallel compiles all that it calls anew, for many seconds where that is
much. Here one short loop calls the work by its address.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numba
import numpy as np
from llvmlite import ir
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
    # First of all: it starts the threads, which loops that were kept on disk take for granted.
    threads = numba.get_num_threads()
    compiled = _compiled_for.get(layout)
    if compiled is None:
        compiled = _compiled_for[layout] = _Compiled.of(work, numba.typeof(data))
    compiled.loop(compiled.address, count, data, threads)


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


_CALLER = ir.FunctionType(ir.VoidType(), [ir.IntType(64), cgutils.intp_t])
"""Of an index and of where the rest is."""


@njit(cache=True)
def _loop(address, count, data, threads):  # type: ignore[no-untyped-def]
    _share_out(_caller(data), _told(address, data), count, threads)


@njit(cache=True, parallel=True)
def _share_out(caller, told, count, threads):  # type: ignore[no-untyped-def]
    """Threads take the next index when they are done with one: what takes long holds up no other work.

    This knows nothing of the data and is compiled once: a parallel loop takes ten times as long as others.
    """
    if count == 1:
        _call(caller, 0, told)
        return
    taken = np.zeros(1, dtype=np.int64)
    for _ in prange(min(count, threads)):
        index = _take(taken)
        while index < count:
            _call(caller, index, told)
            index = _take(taken)


@intrinsic
def _told(typing_context, address, data):  # type: ignore[no-untyped-def]
    """Write down the address of the work's C entry and the data; return where.

    Of arrays references are not counted there, which threads that take parts of the same one would wait for.
    """

    def lent(context: Any, builder: Any, kind: types.Type, value: Any) -> Any:
        if not isinstance(kind, types.Array):
            return value
        array = context.make_array(kind)(context, builder, value)
        array.meminfo = cgutils.get_null_value(array.meminfo.type)
        array.parent = cgutils.get_null_value(array.parent.type)
        return array._getvalue()

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        entry, held = arguments
        parts = zip(data.types, cgutils.unpack_tuple(builder, held), strict=True)
        held = context.make_tuple(builder, data, [lent(context, builder, *part) for part in parts])
        kept = cgutils.alloca_once_value(builder, cgutils.pack_struct(builder, (entry, held)))
        return builder.ptrtoint(kept, cgutils.intp_t)

    return types.intp(address, data), generate


@intrinsic
def _caller(typing_context, data):  # type: ignore[no-untyped-def]
    """Return the address of a function that takes an index and what `_told` wrote, and calls the work."""
    work = types.FunctionType(types.void(types.int64, data))

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        entry = context.get_value_type(work.ftype)
        told = ir.LiteralStructType([cgutils.intp_t, context.get_value_type(data)])
        name = context.mangler("caryatid_caller", (data,))
        function = ir.Function(builder.module, _CALLER, name)
        function.linkage = "internal"
        inner = ir.IRBuilder(function.append_basic_block())
        index, where = function.args
        address, value = cgutils.unpack_tuple(inner, inner.load(inner.inttoptr(where, told.as_pointer())), 2)
        inner.call(inner.inttoptr(address, entry), [index, value])
        inner.ret_void()
        return builder.ptrtoint(function, cgutils.intp_t)

    return types.intp(data), generate


@intrinsic
def _call(typing_context, caller, index, told):  # type: ignore[no-untyped-def]
    """Call what `_caller` made."""

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        function, index, told = arguments
        builder.call(builder.inttoptr(function, _CALLER.as_pointer()), [index, told])
        return context.get_dummy_value()

    return types.void(types.intp, types.int64, types.intp), generate


@intrinsic
def _take(typing_context, taken):  # type: ignore[no-untyped-def]
    """Return the number in an array (1,) and raise it by one, as one step for all threads."""

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        numbers = context.make_array(signature.args[0])(context, builder, arguments[0])
        one = context.get_constant(types.int64, 1)
        return builder.atomic_rmw("add", numbers.data, one, "monotonic")

    return types.int64(taken), generate
