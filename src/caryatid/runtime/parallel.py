"""Parallel work: Python threads call compiled kernels that release the GIL.

numba's parallel loop recompiles everything it calls, which can take many seconds. Here each kernel is
compiled once, and the loop is not compiled. BLAS gets one thread, because the matrices are small and waiting
threads cost more than they save.
"""

from __future__ import annotations

import logging
import os
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from functools import cache, partial, wraps
from pathlib import Path
from threading import TIMEOUT_MAX, Lock
from typing import Any, ParamSpec, TypeVar

import numba
import numpy as np
from filelock import FileLock
from numba import njit
from numba.core.caching import FunctionCache
from numba.core.dispatcher import Dispatcher
from numba.core.event import TimingListener, register
from threadpoolctl import ThreadpoolController

from caryatid.errors import InputError, check_type

P = ParamSpec("P")
Result = TypeVar("Result")

log = logging.getLogger(__name__)
"""Reports that kernels are being compiled."""


_compiling = TimingListener()
register("numba:compile", _compiling)


def read_compile_time() -> float:
    """Time in which kernels were compiled since the program started [s]."""
    return float(_compiling.duration) if _compiling.done else 0.0


class KernelCache(FunctionCache):  # type: ignore[misc]
    """numba's cache of a compiled kernel on disk, safe where several processes or changed sources share it.

    numba notices that the file of a kernel has changed. This also notices a change of the kernels that it
    calls and of the numbers that it uses, wherever they come from.

    Raises:
        InputError: No folder for compiled kernels is writable.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        try:
            super().__init__(function)
        except RuntimeError:
            reason = "no writable folder for compiled kernels"
            raise InputError("NUMBA_CACHE_DIR", reason, "set it to a writable folder") from None
        used = [function.__globals__.get(name) for name in function.__code__.co_names]
        called = (getattr(vars(u)["_cache"], "stamp", None) for u in used if isinstance(u, Dispatcher))
        numbers = (repr(u) for u in used if isinstance(u, (int, float, tuple, np.ndarray)))
        self.stamp = self._cache_file._source_stamp, *called, *numbers
        self._cache_file._source_stamp = self.stamp

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Read a compiled kernel; None if it is new, damaged, or has types that have been renamed."""
        try:
            found = super().load_overload(sig, target_context)
        except Exception:
            self.flush()
            found = None
        if found is None and not any(Path(self.cache_path).glob("*.nbi")):
            _tell_once("compiling kernels (once after installation, about 30 seconds)")
        return found

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep a compiled kernel; two processes that write the index of a kernel at once would garble it."""
        with FileLock(Path(self.cache_path) / "kernels.lock"):
            super().save_overload(sig, data)


_tell_once = cache(log.info)


def kernel(function: Any = None, **options: Any) -> Any:
    """Decorate a kernel: cached on disk, run without the GIL, not compiled for calls from C."""
    if function is None:
        return partial(kernel, **options)
    compiled: Any = njit(error_model="numpy", nogil=True, no_cfunc_wrapper=True, **options)(function)
    if not numba.config.DISABLE_JIT:
        compiled._cache = KernelCache(function)
    return compiled


inner = partial(kernel, no_cpython_wrapper=True)
"""Decorator of kernels that only other kernels call."""

SHARES = 16
"""Shares into which threads divide points, pixels or hypotheses [1]: enough for usual numbers of cores."""


@cache
def cores() -> int:
    """Number of threads: CARYATID_THREADS, or the cores that affinity and control group allow."""
    asked = os.environ.get("CARYATID_THREADS", "")
    if asked.isdecimal() and int(asked) > 0:
        return int(asked)
    own = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    with suppress(OSError, ValueError):  # "max 100000" where there is no limit
        quota, period = map(int, Path("/sys/fs/cgroup/cpu.max").read_text("ascii").split())
        return max(1, min(own, round(quota / period)))
    return own


def one_blas_thread(function: Callable[P, Result]) -> Callable[P, Result]:
    """Let BLAS use one thread while a function runs; numba's kernels keep theirs."""

    @wraps(function)
    def limited(*args: P.args, **kwargs: P.kwargs) -> Result:
        with _blas_limited():
            return function(*args, **kwargs)

    return limited


_lock = Lock()
_running: list[list[tuple[Any, int]]] = []
"""For each function that runs with one BLAS thread: the libraries, and their usual numbers of threads."""


@contextmanager
def _blas_limited() -> Iterator[None]:
    """Limit BLAS, and restore the numbers of threads from before any function that runs now.

    threadpoolctl lets only one thread change them while it is alive, so every thread restores them.
    """
    with _lock:
        usual = _running[0] if _running else [(library, library.num_threads) for library in _blas()]
        _running.append(usual)
    try:
        for library, _ in usual:
            library.set_num_threads(1)
        yield
    finally:
        with _lock:
            _running.pop()
        for library, number in usual:
            library.set_num_threads(number)


def for_each(work: Any, count: int, data: tuple[Any, ...]) -> None:
    """Call the kernel `work(index, data)` for each index below a count, on as many threads as numba uses.

    Data are arrays and numbers, preferably in a `NamedTuple`; results are written to arrays among them. The
    call for one index must not change the data of another, so that the result is the same on any number of
    threads. The kernel must not raise.
    """
    on_threads(lambda index: work(index, data), count)


def on_threads(task: Callable[[int], Result], count: int) -> list[Result]:
    """Results of a task for each index from 0 to count − 1, on as many threads as numba uses.

    A task should call kernels compiled with `nogil=True`; it may call `on_threads` itself.
    """
    results: list[Any] = [None] * count
    indices = iter(range(count))

    def take_share() -> None:
        for index in indices:
            results[index] = task(index)

    threads = numba.get_num_threads()

    def help_out() -> None:
        numba.set_num_threads(threads)
        take_share()

    shares = [_threads(os.getpid()).submit(help_out) for _ in range(min(threads, cores(), count) - 1)]
    try:
        take_share()
    finally:
        deque(indices, maxlen=0)  # where a task failed, no other begins
        begun = [share for share in shares if not share.cancel()]
        wait(begun)
    for share in begun:
        share.result()
    return results


def check_budget(budget: float | None) -> float | None:
    """Return a time [s] that a thread can wait for, or None for no limit.

    Raises:
        InputError: It is no number of at least 0.
    """
    if budget is None:
        return None
    check_type("budget", budget, (float, int), "give seconds, such as 0.2")
    if not budget >= 0.0:
        raise InputError("budget", f"{budget} is not a time", "give seconds, such as 0.2")
    return min(budget, TIMEOUT_MAX / 2.0)


def in_background(task: Callable[P, Result], *args: P.args, **kwargs: P.kwargs) -> Future[Result]:
    """Begin a task in a thread of its own, after those begun before, with the caller's number of threads."""
    threads = numba.get_num_threads()

    def run() -> Result:
        numba.set_num_threads(threads)
        return task(*args, **kwargs)

    return _background(os.getpid()).submit(run)


@cache
def _background(process: int) -> ThreadPoolExecutor:
    """The thread of a process for what nobody waits for."""
    return ThreadPoolExecutor(1, thread_name_prefix="caryatid-background")


@cache
def _threads(process: int) -> ThreadPoolExecutor:
    """The threads of a process: one that was forked has none of its parent's."""
    return ThreadPoolExecutor(numba.config.NUMBA_NUM_THREADS, thread_name_prefix="caryatid")


@cache
def _blas() -> list[Any]:
    return [c for c in ThreadpoolController().lib_controllers if c.user_api == "blas"]
